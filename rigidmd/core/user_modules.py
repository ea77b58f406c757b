"""Python modules of generated and user code, named by a digest of their source.

The cache finds compiled code by the types of its arguments. With such names, a class from a changed
file is a different type, and a class from the same text is the same type in every process. Code
compiled for generated modules is cached on disk. Code compiled for user files is not, because it
may contain values that they import or read.
"""

import hashlib
import sys
from types import ModuleType

#: Prefixes of the names of generated modules and of modules from user files.
GENERATED_PREFIX, USER_FILE_PREFIX = "rigidmd_own_", "rigidmd_file_"


def digest_of(source: bytes) -> str:
    """SHA-256 of a source."""
    return hashlib.sha256(source).hexdigest()


def module_of(source: bytes, file: str, prefix: str = GENERATED_PREFIX) -> ModuleType:
    """The module of a source, executed once per process. Raises whatever the code raises.

    file : its origin, for messages
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
    for value in vars(module).values():
        if isinstance(value, type) and value.__module__ == name:
            # Machine code is found by name, so that classes need distinct names.
            value.__name__ = f"{value.__name__}_{name[-8:]}"
    return module
