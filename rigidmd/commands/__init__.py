"""The command line: cli.py lists the commands; each has a module with its arguments, its call and
what it prints."""

#: Added to the number of a signal that ends a command: exit code 130 for Ctrl-C, 143 for SIGTERM.
BY_SIGNAL = 128
BAD_INPUT, FAILED, INTERRUPTED = 2, 1, BY_SIGNAL + 2
#: Exit code of a run that stopped because its wall time was up: run it again with --resume.
OUT_OF_TIME = 75
