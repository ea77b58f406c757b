"""What pyproject.toml cannot say: the package is built in a temporary folder.

setuptools builds in build/ and packs all that is there: modules that were moved or removed since an
earlier `pip install .` would stay importable.
"""

import atexit
import shutil
import tempfile

from setuptools import setup
from setuptools.command.build import build


class BuildInTemporaryFolder(build):
    def initialize_options(self) -> None:
        super().initialize_options()
        self.build_base = tempfile.mkdtemp(prefix="rigidmd-build-")
        atexit.register(shutil.rmtree, self.build_base, ignore_errors=True)


setup(cmdclass={"build": BuildInTemporaryFolder})
