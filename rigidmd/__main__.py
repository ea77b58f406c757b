"""`python -m rigidmd`."""

import sys

from rigidmd.cli import main

sys.exit(main())
