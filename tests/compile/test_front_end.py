"""Rules for the sources of kernels."""

import ast

from support.common import ROOT


def test_code_for_llvm_does_not_rely_on_typed_pointers():
    """llvmlite removes them: loads and address computations name their type."""
    needed, found = {"load": "typ", "load_atomic": "typ", "gep": "source_etype"}, []
    for path in (ROOT / "rigidmd").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if not (isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute)):
                continue
            name, of_builder = node.func.attr, ast.unparse(node.func.value) in ("builder", "b")
            lacks = of_builder and needed.get(name) not in (
                None,
                *(key.arg for key in node.keywords),
            )
            if name == "as_pointer" or lacks:
                found.append(f"{path.name}:{node.lineno}: {ast.unparse(node)}")
    assert found == []


def compiled_functions():
    """(name, tree, the options) of all compiled functions."""
    for path in (ROOT / "rigidmd").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            for mark in node.decorator_list if isinstance(node, ast.FunctionDef) else ():
                call = mark if isinstance(mark, ast.Call) else ast.Call(mark, [], [])
                kind = getattr(call.func, "id", "")
                if kind in ("kernel", "task", "implements", "chosen_by_type"):
                    keys = {key.arg: ast.unparse(key.value) for key in call.keywords}
                    name = (
                        ast.unparse(call.args[0]).rpartition(".")[2]
                        if kind == "implements"
                        else node.name
                    )
                    yield name, node, keys


def test_loops_without_counted_references_take_elements_by_their_index():
    """Iterating over a view of an array, uncounted, ended in a crash; over ranges and tuples it is
    safe."""
    uncounted = [
        (name, tree)
        for name, tree, keys in compiled_functions()
        if keys.get("count_references") == "False"
    ]
    assert {"block_forces", "set_local", "build_list"} <= {name for name, _ in uncounted}
    strange = []
    for name, tree in uncounted:
        for node in ast.walk(tree):
            over = node.iter if isinstance(node, ast.For) else None
            if isinstance(over, ast.Call) and ast.unparse(over.func) == "enumerate":
                over = over.args[0]
            if over is not None and not isinstance(over, ast.Tuple):
                safe = isinstance(over, ast.Call) and ast.unparse(over.func) in (
                    "range",
                    "literal_unroll",
                )
                strange += [] if safe else [f"{name}: for ... in {ast.unparse(over)}"]
    assert strange == []
