"""`firmware_protocols` turns bytes into messages: nothing but these modules of the standard library may be imported."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[2] / "firmware_protocols"
ALLOWED = {"__future__", "firmware_protocols", "collections", "dataclasses", "enum", "functools", "struct", "typing"}


@pytest.mark.parametrize("path", sorted(FOLDER.rglob("*.py")), ids=lambda path: path.name)
def test_imports(path: Path) -> None:
    imported = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            imported |= {name.name.split(".")[0] for name in node.names}
        elif isinstance(node, ast.ImportFrom):
            imported.add("firmware_protocols" if node.level else (node.module or "").split(".")[0])
    assert imported <= ALLOWED
