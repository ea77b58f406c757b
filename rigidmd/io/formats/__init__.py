"""One module per file format, or per library that reads several formats."""
