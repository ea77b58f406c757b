"""Looking at a finished run: one page, its film, film files. Reads the folder of a run and never changes the run."""
