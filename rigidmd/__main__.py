"""`python -m rigidmd`. Python has put the working directory on the search path, with whatever
modules are there."""

import sys

if not sys.flags.safe_path:
    del sys.path[0]

from rigidmd.commands.cli import main

sys.exit(main())
