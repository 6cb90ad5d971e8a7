"""YAML as people write settings: plain values, nothing that refers to something else."""

from __future__ import annotations

from typing import Any

import yaml

from dgorl.errors import DgorlError


class PlainYamlError(DgorlError):
    """Text that is no plain YAML; ``line`` is where, counted from 1."""

    def __init__(self, line: int, what: str) -> None:
        self.line = line
        super().__init__(what)


class _Plain(yaml.SafeLoader):
    """Refuses anchors and aliases: a few hundred bytes of them stand for gigabytes, and no setting needs any."""

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        event = self.peek_event()  # type: ignore[no-untyped-call]
        if getattr(event, "anchor", None) is not None:
            kind = "an alias (`*`)" if isinstance(event, yaml.AliasEvent) else "an anchor (`&`)"
            what = f"{kind} is not taken here: write the value out"
            raise yaml.MarkedYAMLError(problem=what, problem_mark=event.start_mark)
        return super().compose_node(parent, index)

    def construct_object(self, node: yaml.Node, deep: bool = False) -> Any:
        try:
            return super().construct_object(node, deep)
        except (ValueError, TypeError) as error:
            raise yaml.MarkedYAMLError(problem=str(error), problem_mark=node.start_mark) from error


class _PlainDumper(yaml.SafeDumper):
    """Writes a value out wherever it stands, also one that stands in two places."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


def yaml_text(value: Any) -> str:
    """A value as plain YAML; :func:`plain_yaml` gives it back."""
    text: str = yaml.dump(value, Dumper=_PlainDumper, sort_keys=False, default_flow_style=None, allow_unicode=True)
    return text


def plain_yaml(text: str) -> tuple[Any, yaml.Node | None]:
    """The value of a text, and its node, which knows the lines. Raises PlainYamlError, whatever the text."""
    try:
        loader = _Plain(text)
        node = loader.get_single_node()
        return (None if node is None else loader.construct_document(node)), node
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        raise PlainYamlError(mark.line + 1 if mark else 1, f"not YAML: {error.problem}") from error
    except yaml.reader.ReaderError as error:
        line = text.count("\n", 0, error.position) + 1
        raise PlainYamlError(line, f"not YAML: the character U+{ord(text[error.position]):04X}") from error
    except RecursionError as error:
        raise PlainYamlError(loader.line + 1, "not YAML of settings: nested too deeply") from error
