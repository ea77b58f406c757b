"""`python -m rigidmd`."""

import sys

from rigidmd.commands.cli import main

sys.exit(main())
