"""Options from the command line: a frozen dataclass a subcommand, its field docstrings the help."""

from __future__ import annotations

import io
import sys
from collections.abc import Sequence
from contextlib import nullcontext, redirect_stderr
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, get_args, get_origin

import tyro
from tyro.conf import FlagCreatePairsOff, Positional, UseAppendAction, arg
from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

from dgorl.configuration import nearest
from dgorl.printable import printable

T = TypeVar("T")

_NONE = ""
"""in place of "(default: None)": what an absent option means stands in its docstring"""
Seconds = Annotated[float | None, arg(metavar="SECONDS", help_behavior_hint=_NONE)]
Folder = Annotated[Path | None, arg(metavar="DIR", help_behavior_hint=_NONE)]
File = Annotated[Path | None, arg(metavar="FILE", help_behavior_hint=_NONE)]
LogPath = Annotated[Path | None, arg(metavar="LOG", help_behavior_hint=_NONE)]
LogArgument = Positional[Annotated[Path, arg(metavar="LOG")]]
Names = UseAppendAction[Annotated[tuple[str, ...], arg(metavar="NAME", help_behavior_hint="(repeatable)")]]
Window = Annotated[str | None, arg(metavar="SECONDS|all", help_behavior_hint=_NONE)]
Seed = Annotated[int | None, arg(metavar="INT", help_behavior_hint=_NONE)]


def one_of(words: Sequence[str]) -> PrimitiveConstructorSpec[str]:
    """An option that takes one of these words; for another one the nearest is named."""

    def read(texts: list[str]) -> str:
        if texts[0] not in words:
            raise ValueError(f"`{texts[0]}` is none of {', '.join(words)}{nearest(texts[0], words)}")
        return texts[0]

    return PrimitiveConstructorSpec(
        nargs=1,
        metavar="NAME",
        instance_from_str=read,
        is_instance=lambda value: value in words,
        str_from_instance=lambda value: [value],
    )


_registry = ConstructorRegistry()


def parse(options: type[T], command: str, description: str | None, arguments: Sequence[str]) -> T:
    """The options of ``dgorl COMMAND``; prints help or a usage error and leaves by SystemExit (0 or 2)."""
    said = io.StringIO()
    # tyro repeats arguments as they are, and a shell's `*` makes file names arguments.
    plain = all(argument == printable(argument) for argument in arguments)
    try:
        with _registry, nullcontext() if plain else redirect_stderr(said):
            return tyro.cli(
                options,
                prog=f"dgorl {command}",
                description=description,
                args=list(arguments),
                config=(FlagCreatePairsOff,),
            )
    finally:
        for line in said.getvalue().splitlines():
            print(printable(line), file=sys.stderr)


@_registry.primitive_rule
def _comma_separated(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
    """Tuples of fixed words are written ``range,rssi``."""
    inner = get_args(info.type)
    if get_origin(info.type) is not tuple or len(inner) != 2 or get_origin(inner[0]) is not Literal:
        return None
    words = get_args(inner[0])

    def read(texts: list[str]) -> tuple[str, ...]:
        chosen = tuple(texts[0].split(","))
        for word in chosen:
            if word not in words:
                raise ValueError(f"`{word}` is none of {', '.join(words)}")
        return chosen

    return PrimitiveConstructorSpec(
        nargs=1,
        metavar=",".join(words),
        instance_from_str=read,
        is_instance=lambda value: isinstance(value, tuple) and all(word in words for word in value),
        str_from_instance=lambda value: [",".join(value)],
    )


@_registry.primitive_rule
def _text_or_none(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
    """Text that may be left out, ``none`` then."""
    if set(get_args(info.type)) != {str, type(None)}:
        return None
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar="TEXT",
        instance_from_str=lambda texts: None if texts[0] == "none" else texts[0],
        is_instance=lambda value: value is None or isinstance(value, str),
        str_from_instance=lambda value: ["none" if value is None else value],
    )
