"""`rigidmd help`."""

from rigidmd.commands.arguments import Options, argument, command


@command(
    190, "list the chapters of the documentation, or print one", "rigidmd help water | less",
    argument("chapter", nargs="?", metavar="CHAPTER", help="chapter to print, or a word to find in them"),
)  # fmt: skip
def _help(options: Options) -> int:
    from rigidmd.core.shipped import chapter_text, contents

    if options.chapter is not None:
        print(chapter_text(options.chapter))
        return 0
    print("chapters (`rigidmd help CHAPTER` prints one; `rigidmd COMMAND --help` describes a command):")
    for folder, found in contents().items():
        print(f"\n{folder}")
        for name, about in found.items():
            print(f"  {name:<14}  {about}")
    return 0
