"""Code from outside: modules that are named by their contents.

Compiled code is found again by the types that it was compiled for. A class from a file that has changed is then another
class, and a class from the same text is the same in every process. What is compiled for modules that rigidmd writes is
kept on disk. What is compiled for files of users is not: it may hold values that they import or read.
"""

import hashlib
import sys
from types import ModuleType

#: How the names of modules begin: of those that rigidmd writes, and of files of users.
BY_CONTENT, OF_FILE = "rigidmd_own_", "rigidmd_file_"


def digest_of(source: bytes) -> str:
    """SHA-256 of a source."""
    return hashlib.sha256(source).hexdigest()


def module_of(source: bytes, file: str, prefix: str = BY_CONTENT) -> ModuleType:
    """The module of a source, which is run if this process has not done so yet. Raises whatever the code raises.

    file : where it comes from, for messages
    """
    name = f"{prefix}{digest_of(source)[:32]}"
    if name in sys.modules:
        return sys.modules[name]
    code = compile(source, file, "exec")
    module = ModuleType(name)
    module.__file__ = file
    sys.modules[name] = module
    try:
        exec(code, module.__dict__)
    except BaseException:
        del sys.modules[name]
        raise
    for own in vars(module).values():
        if isinstance(own, type) and own.__module__ == name:
            # Machine code is found by names: two classes of one name must not be taken for each other.
            own.__name__ = f"{own.__name__}_{name[-8:]}"
    return module
