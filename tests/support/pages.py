"""Short runs of a top and of water."""

import base64
import json
import re
import shutil

import numpy as np

CHROMIUM = next(
    (
        path
        for name in ("chromium", "chromium-browser", "google-chrome")
        if (path := shutil.which(name))
    ),
    "",
)


SHORT_WATER = {
    "stages.equilibration.duration_ps": 0.02,
    "stages.equilibration.timestep_fs": 2.0,
    "stages.production.duration_ps": 0.02,
    "output.trajectory_interval_ps": 0.01,
    "output.log_interval_ps": 0.004,
    "output.figures": False,
}


def data_of(page):
    """The data of the animation in a page."""
    found = re.search(
        r'<script type="application/json" id="film-data">(.*?)</script>', page.read_text("utf-8")
    )
    return json.loads(found[1])


def numbers(text, kind):
    return np.frombuffer(base64.b64decode(text), kind)


def is_alone(text):
    """Whether a page loads nothing from elsewhere."""
    own = re.sub(r"<script>.*?</script>", "", text, flags=re.DOTALL)
    return not re.search(
        r"<link|<script[^>]* src|<img[^>]* src=\"(?!data:)|url\((?!#)|@import|<image", own
    )
