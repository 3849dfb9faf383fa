"""A service on DDS as ``rmw_cyclonedds_cpp`` maps it: two topics, and a header before each request and response.

The header is a number of the client and one of the call, which the response returns (``serdata.hpp``,
``cdds_request_header_t``).  Fast DDS sends them beside the data instead, so its services are other ones on the wire:
a client of this server needs ``RMW_IMPLEMENTATION=rmw_cyclonedds_cpp``.
"""

from __future__ import annotations

import secrets
import types
from collections.abc import Iterator
from dataclasses import dataclass, fields
from typing import Any, Final, Generic, TypeVar

from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import int64, uint64

from ros2.wire.node import Node, send
from ros2.wire.qos import reliable

_DEPTH: Final = 10
_64_BITS: Final = (1 << 64) - 1
"""Cyclone's Python binding gives a handle with a sign in one place and without in another."""
MAX_REQUESTS: Final = 16
"""Requests that are taken at a time."""

Request = TypeVar("Request", bound=IdlStruct)
Response = TypeVar("Response", bound=IdlStruct)


@dataclass(frozen=True, slots=True)
class Caller:
    """Who waits for a response: the client and its call, and the handle of the client's writer."""

    client: int
    call: int
    writer: int


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


class ServiceServer(Generic[Request, Response]):
    """The server of ``/name``: hands out requests with their callers, and answers each when its owner is ready to."""

    def __init__(self, node: Node, name: str, request: type[Request], response: type[Response]) -> None:
        identity = f"serviceid={secrets.token_hex(16)};"
        self._request_type, self._reply_type = request, with_header(response)
        self._reader = node.reader(f"rq/{name}Request", with_header(request), reliable(_DEPTH), identity)
        self._writer = node.writer(f"rr/{name}Reply", self._reply_type, reliable(_DEPTH), identity)

    def requests(self) -> Iterator[tuple[Caller, Request]]:
        """The requests that arrived since the last call."""
        for sample in self._reader.take(MAX_REQUESTS):
            info = sample.sample_info
            if info.valid_data:
                caller = Caller(sample.client, sample.call, info.publication_handle & _64_BITS)
                yield caller, self._request_type(*list(fields_of(sample).values())[2:])

    def respond(self, caller: Caller, response: Response) -> None:
        """Answer a call; a caller that is gone hears nothing."""
        send(self._writer, self._reply_type(caller.client, caller.call, **fields_of(response)))

    def callers(self) -> set[int]:
        """The writers of the clients that are there."""
        return {handle & _64_BITS for handle in self._reader.get_matched_publications()}
