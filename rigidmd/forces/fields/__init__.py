"""What acts on molecules from outside: electric fields, gravity, walls, restraints.

These forces are tied to the lab, not to other molecules. The pressure of a box is that of the molecules on one another:
none of these terms adds to the molecular virial. Of each term, `changes_momentum` says which components of the total
momentum it changes, and `tied_to_places` whether its energy depends on where in the lab molecules are.
"""
