"""What acts on molecules from outside: electric fields, gravity, walls, restraints.

These forces are tied to the lab, not to other molecules. The pressure of a box is that of the molecules on one another:
none of these terms adds to the molecular virial. Which components of the total momentum a term lets change, it says
itself (`changes_momentum`).
"""
