"""The networks there are, by the name that configurations and checkpoints give them.

To add one: write its module with an `Architecture` (see `learned.network`) and list it here.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from pydantic import ConfigDict, ValidationError, create_model

from fusion.errors import SkyfixError
from learned import aglnet, hybrid, orienternet, rotmatch, translocnet_matcher, translocnet_voting
from learned.network import Architecture

ARCHITECTURES: dict[str, Architecture] = {
    architecture.name: architecture
    for architecture in (
        rotmatch.ARCHITECTURE,
        orienternet.ARCHITECTURE,
        aglnet.ARCHITECTURE,
        hybrid.ARCHITECTURE,
        translocnet_matcher.ARCHITECTURE,
        translocnet_matcher.COMPACT_ARCHITECTURE,
        translocnet_voting.ARCHITECTURE,
    )
}
"""By name."""


def architecture_named(name: str) -> Architecture:
    """The architecture of a name, or SkyfixError with the names there are."""
    if name not in ARCHITECTURES:
        raise SkyfixError(f"architecture: expected one of {', '.join(ARCHITECTURES)}, got {name!r}")
    return ARCHITECTURES[name]


def settings_from(architecture: Architecture, content: Mapping[str, Any]) -> Any:
    """Settings of an architecture from what JSON or YAML hold; left-out fields get their defaults.

    Raises
    ------
    SkyfixError
        If a key is unknown or a value has the wrong type.
    """
    # A model around a standard dataclass hands its strictness down to it.
    strict = create_model("Strict", __config__=ConfigDict(extra="forbid"), settings=(architecture.settings_type, ...))
    try:
        return vars(strict.model_validate({"settings": dict(content)}))["settings"]
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"][1:])
        message = f"{architecture.name} settings: {where}: {first['msg']}, got {first['input']!r}"
        raise SkyfixError(message) from error


def settings_mapping(architecture: Architecture, settings: Any) -> dict[str, Any]:
    """The inverse of `settings_from`, with the architecture's name in front."""
    return {"architecture": architecture.name, **asdict(settings)}
