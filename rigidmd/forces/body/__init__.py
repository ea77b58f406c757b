"""What acts on a single body: fields, resistance, and the frame of reference."""
