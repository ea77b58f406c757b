"""What acts on a single body: fields, resistance, the axes it is told in."""
