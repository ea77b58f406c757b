"""A table of a scene whose class is in a file that only scenes with the table load."""

from importlib import import_module

from pydantic import BaseModel
from pydantic_core import core_schema


class TableInFile:
    """Annotation of a key: its table is of the class in a module that has the name of the module in
    CamelCase."""

    def __init__(self, module: str):
        self.module = module

    @property
    def model(self) -> type[BaseModel]:
        name = self.module.rpartition(".")[2]
        return getattr(import_module(self.module), name.title().replace("_", ""))

    def __get_pydantic_core_schema__(self, source, handler):
        return core_schema.no_info_plain_validator_function(lambda x: self.model.model_validate(x))

    def __get_pydantic_json_schema__(self, schema, handler):
        self.model.model_rebuild()
        return handler(self.model.__pydantic_core_schema__)
