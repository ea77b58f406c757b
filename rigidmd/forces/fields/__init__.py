"""External forces on molecules: electric fields, gravity, walls, restraints.

Each module has the terms for one kind of field, a function `term` that makes a term from the
parts of a system and a scene table, and a function `sentence` that describes it.
`scene.fields.FIELDS` names the module.

They do not act between molecules, so none of them adds to the molecular virial, from which the
pressure of a box is computed. The attribute `changes_momentum` of a term lists the components of
the total momentum that it changes. `absolute_positions` is whether its energy depends on the
positions of molecules in the lab.
"""
