"""The command line: cli.py lists the commands. Each has a module with its arguments, its call and
what it prints."""

from rigidmd.core.process import BY_SIGNAL
from rigidmd.core.process import OUT_OF_TIME as OUT_OF_TIME

BAD_INPUT = 2
FAILED = 1
INTERRUPTED = BY_SIGNAL + 2
