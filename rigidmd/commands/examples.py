"""`rigidmd examples`."""

from rigidmd.commands.arguments import Options, command
from rigidmd.features import FEATURES

NUMBER = 6  # width of the column of numbers of molecules


@command(
    "Start", 20, "list the scenes, notebooks and scripts that rigidmd ships", "rigidmd examples"
)
def _examples(options: Options) -> int:
    from rigidmd.core.shipped import NOTEBOOKS, SCRIPTS, examples

    scenes = examples()
    titles = {"molecules": "molecules"} | {row.kind: row.kind_title for row in FEATURES if row.kind}
    kinds = {
        **{
            title: [example for example in scenes if table in example.tables]
            for table, title in titles.items()
        },
        "notebooks": examples(NOTEBOOKS),
        "scripts, which extend it": examples(SCRIPTS),
    }
    width = max(len(example.name) for example in scenes)
    for title, shipped in kinds.items():
        has_size = any(example.molecules for example in shipped)
        print(f"{title}:{'number':>{width + NUMBER + 3 - len(title)}}" if has_size else f"{title}:")
        for example in shipped:
            number = f"{example.molecules or '':>{NUMBER}}  " if has_size else ""
            print(f"  {example.name:<{width}}  {number}{example.about}")
        print()
    print("`rigidmd new NAME` copies one into the working directory, `rigidmd run NAME.toml` runs")
    print("it, and `rigidmd view runs/NAME` shows it in a browser")
    return 0
