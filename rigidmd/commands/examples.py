"""`rigidmd examples`."""

from rigidmd.commands.arguments import Options, command


@command(10, "list the scenes, notebooks and scripts that rigidmd ships", "rigidmd examples")
def _examples(options: Options) -> int:
    from rigidmd.core.shipped import NOTEBOOKS, SCRIPTS, examples

    scenes = examples()
    kinds = {
        "molecules": [example for example in scenes if not example.is_body],
        "one body": [example for example in scenes if example.is_body],
        "notebooks": examples(NOTEBOOKS),
        "scripts, which extend it": examples(SCRIPTS),
    }
    width = max(len(example.name) for example in scenes)
    for title, shipped in kinds.items():
        print(f"{title}:")
        for example in shipped:
            print(f"  {example.name:<{width}}  {example.about}")
        print()
    print("`rigidmd new NAME` copies one into the working directory")
    return 0
