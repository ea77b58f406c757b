"""Forces: the dispatch over force terms, pair potentials, neighbour lists, Ewald sums, fields,
forces on a body."""
