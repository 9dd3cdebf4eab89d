"""The public names and their modules, as the package's stub lists them."""
import ast
from pathlib import Path

import pdavis_cv

STUB = Path(pdavis_cv.__file__).with_suffix(".pyi")
ROOMS, HOMES = [], {}
for node in ast.parse(STUB.read_text()).body:
    if isinstance(node, ast.ImportFrom):
        assert all(alias.name == alias.asname for alias in node.names), "not exported"
        if node.module is None:
            ROOMS += [alias.name for alias in node.names]
        else:
            HOMES |= {alias.name: node.module for alias in node.names}
