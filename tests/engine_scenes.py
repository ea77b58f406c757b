"""Small scenes on which engines are held against each other."""

PME = {"electrostatics": "pme", "cutoff_A": 7.0}
WALL = [{"model": "argon", "count": 20, "frozen": True}, {"model": "spce", "count": 30}]
#: Ten systems of every kind, in a cube of 15 Å unless they say otherwise: name -> models and counts, tables of the scene.
SCENES = {
    "three sites": ({"spce": 30}, {"forces": PME}),
    "four sites": ({"tip4p2005": 30}, {"forces": PME}),
    "five sites": ({"tip5p": 30}, {"forces": PME}),
    "nitrogen": ({"nitrogen": 40}, {"forces": {"cutoff_A": 7.0}}),
    "carbon dioxide": ({"co2_epm2": 20}, {"forces": PME}),
    "benzene": ({"benzene_opls": 8}, {"forces": PME}),
    "mixture": ({"spce": 20, "nitrogen": 10, "argon": 5}, {"forces": {"cutoff_A": 7.0}}),
    "ions": ({"spce": 20, "na_spce": 3, "cl_spce": 3}, {"forces": PME}),
    "frozen wall": ({}, {"molecules": WALL, "forces": PME}),
    "triclinic": (
        {"spce": 40},
        {"forces": PME, "box": {"lengths_A": [16.0, 17.0, 18.0], "angles_deg": [75.0, 80.0, 70.0]}},
    ),
}
