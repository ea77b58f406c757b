"""`rigidmd help`."""

from rigidmd.commands.arguments import Options, argument, command


@command(
    "Start",
    40,
    "list the pages of the documentation, print one, or find a word",
    "rigidmd help water",
    argument(
        "chapter",
        nargs="?",
        metavar="CHAPTER",
        help="chapter to print, on a terminal with $PAGER, or a word",
    ),
)
def _help(options: Options) -> int:
    import os
    from pydoc import pager
    from textwrap import fill

    from rigidmd.core.shipped import chapter_text, contents

    if options.chapter is not None:
        os.environ.setdefault("LESS", "FRX")  # `less` then ends at once after a text of one screen
        # $PAGER or `less` on a terminal, else plain text
        pager(f"{chapter_text(options.chapter)}\n")
        return 0
    print(
        "chapters (`rigidmd help CHAPTER` prints one; `rigidmd COMMAND --help` describes a"
        " command):"
    )
    for folder, pages in contents().items():
        lines = [
            fill(f"  {name:<14}  {about}", 120, subsequent_indent=" " * 18)
            for name, about in pages.items()
        ]
        print(f"\n{folder}", *lines, sep="\n")
    return 0
