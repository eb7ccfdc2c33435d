"""Docstrings name things as Sphinx does, :func:`skylamp.render`; the pages show them as code."""

import re

import griffe


class Roles(griffe.Extension):
    def on_object(self, *, obj, **kwargs):
        if obj.docstring:
            obj.docstring.value = re.sub(r":\w+:`~?([\w.]+)`", r"`\1`", obj.docstring.value)
