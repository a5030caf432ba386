"""XML without document types: no entity can be declared, so none can expand."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

from fusecap.inputs import InputKind, read_bytes


class XmlError(ValueError):
    """Broken XML, or XML that declares a document type."""


class _Builder(ElementTree.TreeBuilder):
    def doctype(self, name: str, pubid: str | None, system: str | None) -> None:
        """Called for <!DOCTYPE ...>, before anything in it could be used."""
        raise XmlError("declares a document type (<!DOCTYPE>), which is not read; remove it")


def parse(path: Path, kind: InputKind) -> ElementTree.Element:
    """The root element; raises `XmlError` with the line of the damage, or `kind.error`."""
    parser = ElementTree.XMLParser(target=_Builder())
    content = read_bytes(path, kind)
    try:
        parser.feed(content)
        return parser.close()
    except ElementTree.ParseError as error:
        raise XmlError(f"broken or truncated XML: {error}") from None
