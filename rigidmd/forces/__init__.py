"""Force laws, one a file, and the one dispatch over them (`terms`)."""
