# An analysis, with its errors and figure: `rigidmd analyse RUN --trust layers.py --only layers`.
import numpy as np

import rigidmd


@rigidmd.analysis.register
def layers(frames):
    "fraction of molecules in the lower half of the box, and spread of their heights (Å)"
    height = frames.positions[:, :, 2] % frames.cell[:, 2, 2][:, None]
    return {
        "lower": (height < frames.cell[:, 2, 2][:, None] / 2).mean(axis=1),
        "spread": np.std(height, axis=1),
    }


if __name__ == "__main__":
    scene = rigidmd.Scene.from_dict(
        {
            "box": {"lengths_A": 25},
            "molecules": [{"model": "argon", "count": 256}],
            "stages": [
                {"ensemble": "nvt", "temperature_K": 94, "duration_ps": 4, "timestep_fs": 4}
            ],
            "output": {"trajectory_interval_ps": 0.1},
        }
    )
    found = rigidmd.analysis.analyse(rigidmd.Simulation(scene).run(), "layers")
    print(found)
    assert len(found.values) == 2
