"""What acts: the one dispatch over terms (`terms`), laws between pairs, pairs, waves, and what acts on one body."""
