"""Lets a program import modules with other source than that of their files, as a part would be added or deleted."""

import ast
from collections.abc import Callable, Collection
from importlib.machinery import SourceFileLoader
from pathlib import Path

PLACES = "splatting.registry", "arguments.features"  # where the lines and the entries of parts are


def edit(sources: dict[str, Callable[[str], str]]) -> None:
    """Import the modules of these names, from now on, with what the functions make of their source."""
    plain = SourceFileLoader.get_code

    def get_code(loader: SourceFileLoader, name: str) -> object:
        if name not in sources:
            return plain(loader, name)
        return compile(sources[name](Path(loader.path).read_text(encoding="utf-8")), loader.path, "exec")

    SourceFileLoader.get_code = get_code


class _Without(ast.NodeTransformer):
    """Removes parts: their imports, their items of tuples, and their entries of tables."""

    def __init__(self, hidden: Collection[str]) -> None:
        self._hidden = hidden
        self._classes = {"".join(map(str.capitalize, name.split("_"))) for name in hidden}

    def visit_ImportFrom(self, node: ast.ImportFrom) -> ast.ImportFrom | None:
        return None if node.module.rpartition(".")[2] in self._hidden else node

    def visit_Tuple(self, node: ast.Tuple) -> ast.Tuple:
        node.elts = [item for item in node.elts if getattr(item, "id", "") not in self._classes]
        return node

    def visit_Dict(self, node: ast.Dict) -> ast.Dict:
        pairs = zip(node.keys, node.values, strict=True)
        kept = [(key, value) for key, value in pairs if getattr(key, "value", "") not in self._hidden]
        node.keys, node.values = map(list, zip(*kept, strict=True))
        return node


def without(source: str, hidden: Collection[str]) -> str:
    """Return a source without what it says of the hidden parts."""
    return ast.unparse(_Without(hidden).visit(ast.parse(source)))
