"""Print the full default configuration as YAML, every setting with its meaning and unit.

Example: dgorl config > mine.yaml
"""

from __future__ import annotations

import ast
import dataclasses
import inspect
import json
import re
import textwrap
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from dgorl.configuration import Configuration, as_dict

COMMENT_COLUMN = 36


@dataclass(frozen=True)
class Options:
    """What ``dgorl config`` can be told."""

    json: bool = False
    """one JSON object, without comments"""


def main(options: Options) -> None:
    """Print it."""
    print(json.dumps(as_dict(Configuration())) if options.json else "\n".join(commented(Configuration())))


def commented(value: Any, indent: str = "") -> Iterator[str]:
    """Lines of YAML of a configuration, which read back as it, with the fields' docstrings as comments."""
    comments = docstrings(type(value))
    for field in dataclasses.fields(value):
        item = getattr(value, field.name)
        if dataclasses.is_dataclass(item):
            yield f"\n{indent}{field.name}:{_comment(type(item).__doc__ or '')}"
            yield from commented(item, f"{indent}  ")
        else:
            # Scalars, lists and mappings of JSON are YAML as well.
            text = f"{indent}{field.name}: {json.dumps(as_dict(item), ensure_ascii=False)}"
            yield text.ljust(COMMENT_COLUMN) + _comment(comments.get(field.name, ""))


def docstrings(configuration: type) -> dict[str, str]:
    """Field → the string that follows it in the class's source."""
    (definition,) = ast.parse(textwrap.dedent(inspect.getsource(configuration))).body
    assert isinstance(definition, ast.ClassDef)
    found = {}
    for field, below in zip(definition.body, definition.body[1:], strict=False):
        if isinstance(field, ast.AnnAssign) and isinstance(below, ast.Expr):
            found[ast.unparse(field.target)] = ast.literal_eval(below.value)
    return found


def _comment(text: str) -> str:
    said = re.sub(r" \(METHOD §\d+\)", "", " ".join(text.split()))  # which users do not have
    return f"  # {said}" if said else ""
