"""Writer of a molecular model as a TOML file."""

import json
from pathlib import Path

from rigidmd.core.files import write_text
from rigidmd.scene.models import LENNARD_JONES, MoleculeFile, Site

#: Head of a file whose sites have no interactions.
TO_FILL_IN = """# Sites have masses only and do not interact. Add the parameters of each site:
#   charge_e = -0.1            charge in elementary charges
#   sigma_A = 3.5              Lennard-Jones diameter
#   epsilon_kJ_mol = 0.3       well depth, or epsilon_kcal_mol or epsilon_K
# and the source of the numbers in `source`.
"""


def write_model(path: Path, model: MoleculeFile) -> None:
    """Write a model, which is read back to the same bits. Raises OutputError."""
    write_text(path, model_text(model))


def model_text(model: MoleculeFile) -> str:
    idle = all(site.charge_e is None and site.sigma_A is None and not site.parameters for site in model.sites)
    head = [f"{key} = {_text(value)}" for key in ("name", "title", "source", "note") if (value := getattr(model, key))]
    if model.residue_names:
        head.append(f"residue_names = [{', '.join(map(_text, model.residue_names))}]")
    return "\n".join([*([TO_FILL_IN] if idle else []), *head, *(f"\n{_site(site)}" for site in model.sites), ""])


def _site(site: Site) -> str:
    lines = ["[[sites]]", f"name = {_text(site.name)}"]
    if site.element != "X":
        lines.append(f"element = {_text(site.element)}")
    for key in ("mass_u", "position_A", "charge_e", *LENNARD_JONES):
        value = getattr(site, key)
        if value is not None:
            text = f"[{', '.join(map(repr, value))}]" if isinstance(value, tuple) else repr(value)
            lines.append(f"{key} = {text}")
    if site.parameters:
        items = ", ".join(f"{_text(name)} = {value!r}" for name, value in site.parameters.items())
        lines.append(f"parameters = {{ {items} }}")
    return "\n".join(lines)


def _text(value: str) -> str:
    return json.dumps(value, ensure_ascii=False)
