"""A griffe extension: the comment behind a field, where this library writes units and shapes, is its docstring."""

from __future__ import annotations

import io
import tokenize

from griffe import Attribute, Docstring, Extension


class Comments(Extension):
    """Gives attributes without a docstring the comment on their last line."""

    def on_attribute_instance(self, *, attr: Attribute, **kwargs) -> None:
        if attr.docstring is not None or attr.lineno is None or attr.endlineno is None or not attr.filepath:
            return
        lines = attr.lines_collection[attr.filepath][attr.lineno - 1 : attr.endlineno]
        try:
            tokens = list(tokenize.generate_tokens(io.StringIO("\n".join(line.strip() for line in lines)).readline))
        except (tokenize.TokenError, IndentationError):  # a field that is no statement by itself
            return
        said = [t.string.lstrip("# ") for t in tokens if t.type == tokenize.COMMENT]
        said = [text for text in said if not text.startswith("noqa")]
        if said:
            attr.docstring = Docstring(said[-1], lineno=attr.endlineno, parent=attr)
