"""The header that ``rmw_cyclonedds_cpp`` puts before each request and response (``serdata.hpp``)."""

from __future__ import annotations

import types
from dataclasses import dataclass, fields
from typing import Any

from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import int64, uint64


def with_header(message: type[IdlStruct]) -> Any:
    """The type that travels for ``message``: the number of the client, that of its call, and the message's fields.

    It has the name of the message alone, because ``cdds_request_header_t`` is no part of the type.
    """

    def body(namespace: dict[str, Any]) -> None:
        namespace["__annotations__"] |= {"client": uint64, "call": int64} | message.__annotations__

    return dataclass(types.new_class("Call", (IdlStruct,), {"typename": message.__idl_typename__}, body))


def fields_of(message: Any) -> dict[str, Any]:
    """The fields of a message by name."""
    return {field.name: getattr(message, field.name) for field in fields(message)}
