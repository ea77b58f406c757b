"""Gravity."""

from support.common import small_scene
from support.fields import HELD, LJ, NO_BOX

from rigidmd.assemble.build import build


def test_gravity_may_fall_where_something_stops_it():
    down = {"gravity_m_s2": [0.0, 0.0, -1e10]}
    frozen = [{"model": "argon", "count": 3}, {"model": "krypton", "count": 2, "frozen": True}]
    for fields, more in (
        (down | {"walls": [LJ]}, {}),
        (down | {"restraints": [HELD | {"molecules": [1]}]}, {}),
        (down, {"molecules": frozen}),
        (down, NO_BOX),
    ):
        assert "gravity" in build(small_scene({"argon": 4}, 30.0, fields=fields, **more)).terms
