"""What acts on a single body: fields and resistance."""
