"""Safe XML parsing: a tree of the wanted elements, each with its line.

Document types, entities and external references are refused (defusedxml).  Other elements are skipped with their
content.  The numbers of elements, depth and text are limited, so that a hostile file costs bounded time and memory.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Final
from xml.etree.ElementTree import ParseError
from xml.parsers.expat import errors as xml_errors

from defusedxml.common import DefusedXmlException
from defusedxml.ElementTree import DefusedXMLParser

from autonomy.missions.model import MissionError

MAX_ELEMENTS: Final = 1_000_000
MAX_ATTRIBUTES: Final = 1_000_000
MAX_TEXT: Final = 16 << 20
"""Characters in the kept elements; 100 000 positions with all their digits have 6 million."""
MAX_TOKEN_BYTES: Final = 1 << 18
"""Of one tag or comment, which the parser takes whole."""
MAX_DEPTH: Final = 100
ANY: Final = "*"
"""Key of the limit on all kept elements."""
_CHUNK: Final = 1 << 16
_UTF_16: Final = (b"\xff\xfe", b"\xfe\xff")
_CUT: Final = frozenset(
    xml_errors.codes[text]
    for text in (
        xml_errors.XML_ERROR_NO_ELEMENTS,
        xml_errors.XML_ERROR_UNCLOSED_TOKEN,
        xml_errors.XML_ERROR_PARTIAL_CHAR,
        xml_errors.XML_ERROR_UNCLOSED_CDATA_SECTION,
    )
)
"""What the parser says of a document that ends too early."""


_NO_CHILDREN: Final[Any] = ()
_NO_ATTRIBUTES: Final[dict[str, str]] = {}


@dataclass(slots=True)
class Element:
    """An element: its local name, namespace, attributes by local name, line, text before its first child, children."""

    name: str
    namespace: str
    attributes: dict[str, str]
    line: int
    text: str = ""
    children: list[Element] = _NO_CHILDREN

    def all(self, *names: str) -> Iterator[Element]:
        """Yield the children of these names."""
        return (child for child in self.children if child.name in names)

    def first(self, *path: str) -> Element | None:
        """Find the first descendant along a path of names, or None."""
        at: Element | None = self
        for name in path:
            at = next(at.all(name), None) if at is not None else None
        return at

    def value(self, *path: str) -> str:
        """Return the stripped text of the first descendant along a path, "" without one."""
        element = self.first(*path)
        return "" if element is None else element.text.strip()


class _Builder:
    """Parser target: keeps wanted elements, counts all."""

    def __init__(
        self, name: str, wanted: frozenset[str], limits: Mapping[str, tuple[int, str]], inside: str = ""
    ) -> None:
        self.name, self.wanted, self.limits, self.inside = name, wanted, dict(limits), inside
        self.outside = 0
        self.more = 0
        self.counts: dict[str, int] = {}
        self.elements = self.attributes = self.characters = 0
        self.skipping = 0
        self.parts: list[str] = []
        self.open: list[Element] = []
        self.root: Element | None = None
        self.line: Callable[[], int] = lambda: 0

    def excess(self, code: str, sentence: str) -> MissionError:
        """Make the error of a file that has more than any mission needs."""
        return MissionError(code, f"{sentence}; thin it out, or split the mission", f"{self.name}:{self.line()}")

    def start(self, tag: str, attributes: dict[str, str]) -> None:
        """Handle the start of an element."""
        self.elements += 1
        if self.elements > MAX_ELEMENTS:
            raise self.excess("mission.too-many-elements", f"has more than {MAX_ELEMENTS} elements")
        self.attributes += len(attributes)
        if self.attributes > MAX_ATTRIBUTES:
            raise self.excess("mission.too-many-elements", f"has more than {MAX_ATTRIBUTES} attributes")
        if self.skipping:
            self.skipping += 1
            return
        namespace, _, name = tag.rpartition("}")
        if self.inside and not self.open and (name != self.inside or self.root is not None):
            self.outside += 1
            self.more += name == self.inside
            if self.outside > MAX_DEPTH:
                raise self.excess("mission.nesting", "is nested deeper than any mission")
            return
        self._end_text()
        if self.open and name not in self.wanted:
            self.skipping = 1
            return
        if len(self.open) >= MAX_DEPTH:
            raise self.excess("mission.nesting", "is nested deeper than any mission")
        for counted in (name, ANY):
            if counted in self.limits:
                limit, description = self.limits[counted]
                self.counts[counted] = self.counts.get(counted, 0) + 1
                if self.counts[counted] > limit:
                    raise self.excess("mission.too-many-elements", f"has more than {limit} {description}")
        local = {key.rpartition("}")[2]: value for key, value in attributes.items()} or _NO_ATTRIBUTES
        element = Element(name, namespace.lstrip("{"), local, self.line())
        if self.open:
            self.open[-1].children = self.open[-1].children or []
            self.open[-1].children.append(element)
        else:
            self.root = element
        self.open.append(element)

    def end(self, _tag: str) -> None:
        """Handle the end of an element."""
        if self.skipping:
            self.skipping -= 1
        elif not self.open:
            self.outside -= 1
        else:
            self._end_text()
            self.open.pop()

    def data(self, text: str) -> None:
        """Take the text of the open element."""
        if self.open and not self.skipping and not self.open[-1].children:
            self.parts.append(text)
            self.characters += len(text)
            if self.characters > MAX_TEXT:
                raise self.excess("mission.too-many-elements", f"has more than {MAX_TEXT >> 20} MB of text")

    def _end_text(self) -> None:
        if self.parts:
            self.open[-1].text += "".join(self.parts)
            self.parts.clear()

    def close(self) -> Element | None:
        """Return the tree."""
        return self.root


def root_name(data: bytes) -> str:
    """Read the local name of the root element, "" if there is none in the first 64 kB."""
    builder = _Builder("", frozenset(), {})
    parser = DefusedXMLParser(target=builder, forbid_dtd=True)
    with suppress(ParseError, DefusedXmlException, ValueError, LookupError):
        parser.feed(data[:_CHUNK])
    return builder.root.name if builder.root is not None else ""


def tree(
    data: bytes, name: str, wanted: frozenset[str], limits: Mapping[str, tuple[int, str]], inside: str = ""
) -> Element:
    """Return the root of an XML document with the elements named ``wanted`` below it.

    ``limits`` has the greatest number of elements by name (``ANY``: of all kept ones), and their name in the error.
    ``inside`` is the name of the element to return instead of the root, where a document is an envelope round it.

    Raises:
        MissionError: not well-formed XML, a document type or an entity, more than the limits allow, or no element
            ``inside`` or several.
    """
    builder = _Builder(name, wanted, limits, inside)
    parser = DefusedXMLParser(target=builder, forbid_dtd=True)
    builder.line = lambda: parser.parser.CurrentLineNumber
    try:
        for start in range(0, len(data), _CHUNK):
            parser.feed(data[start : start + _CHUNK])
            if start + _CHUNK - parser.parser.CurrentByteIndex > MAX_TOKEN_BYTES + _CHUNK:
                sentence = f"has a tag or comment of more than {MAX_TOKEN_BYTES >> 10} kB"
                raise builder.excess("mission.too-many-elements", sentence)
        root = parser.close()
    except DefusedXmlException:
        raise MissionError(
            "mission.xml-doctype",
            "declares a document type or entities, which no mission needs and which can do harm; delete the "
            "<!DOCTYPE ...> part",
            f"{name}:{builder.line()}",
        ) from None
    except MissionError:
        raise
    except ParseError as error:
        raise _refusal(data, error, parser.parser.ErrorByteIndex, name) from None
    except (ValueError, LookupError) as error:
        sentence = f"its encoding cannot be read ({error}); save the file with UTF-8"
        raise MissionError("mission.encoding", sentence, name) from None
    if root is None:
        reason = f"has no <{inside}>" if inside else "is empty"
        raise MissionError("mission.empty-file", reason, name)
    if builder.more:
        sentence = f"is an envelope of {builder.more + 1} <{inside}>; save each one as a file of its own"
        raise MissionError("mission.envelope", sentence, name)
    root_element: Element = root
    return root_element


def _refusal(data: bytes, error: ParseError, at_byte: int, name: str) -> MissionError:
    """Tell why the parser refused a document."""
    location = f"{name}:{error.position[0]}"
    reason = str(error).partition(":")[0]
    if error.code in _CUT:
        return MissionError(
            "mission.not-xml", f"this is not well-formed XML: {reason}; was the file cut off?", location
        )
    if error.code == xml_errors.codes[xml_errors.XML_ERROR_MISPLACED_XML_PI]:
        return MissionError(
            "mission.xml-start",
            "something stands before <?xml; delete what comes before it, blanks and lines too",
            location,
        )
    if error.code == xml_errors.codes[xml_errors.XML_ERROR_UNBOUND_PREFIX]:
        sentence = "this element or attribute has a prefix that no xmlns: declares; declare it, or delete the element"
        return MissionError("mission.xml-prefix", sentence, location)
    if error.code == xml_errors.codes[xml_errors.XML_ERROR_UNDEFINED_ENTITY]:
        sentence = "this contains an entity that XML does not know, such as &ntilde;; write the character itself"
        return MissionError("mission.xml-entity", sentence, location)
    if error.code == xml_errors.codes[xml_errors.XML_ERROR_INCORRECT_ENCODING]:
        return MissionError(
            "mission.encoding",
            "the encoding in <?xml ...?> is not that of the file; save the file with UTF-8",
            location,
        )
    if error.code == xml_errors.codes[xml_errors.XML_ERROR_INVALID_TOKEN]:
        try:
            data[: at_byte + 8].decode("utf-8")
        except UnicodeDecodeError as decode_error:
            if decode_error.start <= at_byte and not data.startswith(_UTF_16):
                sentence = f"byte {decode_error.start} is not UTF-8 text; save the file with the encoding UTF-8"
                return MissionError("mission.encoding", sentence, location)
    return MissionError("mission.not-xml", f"this is not well-formed XML: {reason}", location)
