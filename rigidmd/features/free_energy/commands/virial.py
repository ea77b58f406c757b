"""`rigidmd virial`."""

import argparse
from itertools import combinations_with_replacement
from pathlib import Path

from rigidmd.commands.arguments import TRUST, Options, argument, command, flag, number, repeated
from rigidmd.commands.streams import progress_bar


def _temperatures(text: str) -> list[float]:
    """Temperatures in a list such as 300,400,500."""
    try:
        return [float(part) for part in text.split(",")]
    except ValueError:
        raise argparse.ArgumentTypeError(
            f"{text!r} are not temperatures in K, such as 300,400,500"
        ) from None


@command(
    "Study",
    40,
    "compute second virial coefficients of models, with errors. Several models give cross "
    "coefficients too",
    "rigidmd virial spce nitrogen_trappe --temperatures 300,400,500",
    argument(
        "models",
        nargs="+",
        metavar="MODEL",
        help=(
            "shipped model, or the .toml file of a custom model. With several models, all pairs"
            " are computed"
        ),
    ),
    argument(
        "--temperatures",
        type=_temperatures,
        required=True,
        metavar="T,T,...",
        help="temperatures in K, separated by commas",
    ),
    argument(
        "--error",
        type=number(float, 1e-12, 1e12, "an error above 0"),
        metavar="VALUE",
        help=(
            "standard error of each coefficient in cm³/mol (default: 0.1 %% of the larger of |B2|"
            " and |T dB2/dT|)"
        ),
    ),
    repeated(
        "--set",
        "KEY=VALUE",
        help=(
            "key of [forces] of a scene, such as forces.mixing=geometric, or forces.custom with"
            " pair potentials. Can be repeated"
        ),
        dest="overrides",
    ),
    TRUST,
    argument("-o", "--output", metavar="FILE", help="also write the table as a .csv file"),
    flag("--force", help="replace that file"),
    scene="virial",
)
def _virial(options: Options) -> int:
    from rigidmd.features.free_energy.virial import second_virial, table_of
    from rigidmd.features.potentials.user_code.trust import trust_file
    from rigidmd.io.write import check_target
    from rigidmd.scene import parse_override

    for path in options.trust:
        trust_file(path)
    if options.output:
        check_target(Path(options.output), (".csv",), force=options.force)
    settings = dict(parse_override(text) for text in options.overrides)
    results = []
    with progress_bar() as progress:
        pairs = list(combinations_with_replacement(dict.fromkeys(options.models), 2))
        for k, pair in enumerate(pairs):

            def of_all(fraction: float, k: int = k, name: str = "-".join(pair)) -> None:
                progress((k + fraction) / len(pairs), name)

            of_all(0.0)
            result = second_virial(
                *pair,
                temperatures=options.temperatures,
                error=options.error,
                settings=settings,
                progress=of_all,
            )
            results.append(result)
    table = table_of(results)
    print(table.text())
    if options.output:
        table.write(Path(options.output))
    return 0
