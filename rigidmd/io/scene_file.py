"""Writers of TOML: the scene of a run with all defaults and copies of its input files, and a
molecular model."""

import re
import shutil
from pathlib import Path

import tomli_w

from rigidmd.core.files import atomic_file, write_text
from rigidmd.core.toml import Json, plain_values
from rigidmd.formats import STRUCTURE
from rigidmd.io.folder import SCENE
from rigidmd.scene import Scene, is_molecular
from rigidmd.scene.base import format_toml, override
from rigidmd.scene.models import MoleculeFile


def input_names(scene: Scene) -> dict[str, str]:
    """Names of the copies of a scene's input files: dotted key -> unique name. Copies of copies
    keep their names."""
    names = {key: path.name for key, path in scene.inputs.items()} | dict.fromkeys(
        scene.embedded_files, STRUCTURE
    )
    starts = {
        key: f"input_{re.sub(r'[.](file|module|table)$|^molecules[.]', '', key)}_" for key in names
    }
    return {key: starts[key] + name.removeprefix(starts[key]) for key, name in names.items()}


def write_scene(folder: Path, scene: Scene) -> None:
    """Write the scene into the folder of a run, so that it can be run again. Keys without effect
    are left out."""
    data = plain_values(scene.model_dump(exclude_none=True))
    if is_molecular(scene):
        for section, table in [
            (scene.forces, data["forces"]),
            *zip(scene.stages, data["stages"], strict=True),
        ]:
            for key in section.idle_keys:
                table.pop(key, None)
    for key, copied in input_names(scene).items():
        with atomic_file(folder / copied) as temporary:
            if key in scene.embedded_files:
                temporary.write_bytes(scene.embedded_files[key])
            else:
                shutil.copyfile(scene.inputs[key], temporary)
        override(data, key, copied)
    write_text(folder / SCENE, tomli_w.dumps(data))


#: Head of a file whose sites have no interactions.
TO_FILL_IN = """# Sites have masses only and do not interact. Add the parameters of each site:
#   charge_e = -0.1            charge in elementary charges
#   sigma_A = 3.5              Lennard-Jones diameter
#   epsilon_kJ_mol = 0.3       well depth, or epsilon_kcal_mol or epsilon_K
# and the source of the numbers in `source`.
"""


def write_model(path: Path, model: MoleculeFile) -> None:
    """Write a model, which is read back to the same bits. Raises OutputError."""
    idle = all(
        site.charge_e is None and site.sigma_A is None and not site.parameters
        for site in model.sites
    )
    data = model.model_dump(exclude_defaults=True)
    sites = data.pop("sites")
    tables = [_lines(data), *(f"\n[[sites]]\n{_lines(site)}" for site in sites)]
    write_text(path, "\n".join([*([TO_FILL_IN] if idle else []), *tables, ""]))


def _lines(table: Json) -> str:
    return "\n".join(f"{key} = {format_toml(value)}" for key, value in table.items())
