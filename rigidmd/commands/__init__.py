"""The command line. Commands print and never compute."""
