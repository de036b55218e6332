# SPDX-License-Identifier: Apache-2.0
"""A page without a browser and a server."""

import contextlib
from types import SimpleNamespace


class Desk:
    """A page of nothing but its inputs, by label."""

    def __init__(self):
        self.gui, self.controls = self, contextlib.nullcontext()
        self.message, self.inputs, self.clicks = SimpleNamespace(content=''), {}, {}

    def add_folder(self, _):
        return self.controls

    def add_input(self, label, *numbers, initial_value=None, **_):
        value = numbers[-1] if numbers and initial_value is None else initial_value
        handle = SimpleNamespace(label=label, content=label, value=value)
        handle.on_click = lambda act: self.clicks.update({label: act})
        self.inputs[label] = handle
        return handle

    add_button = add_button_group = add_dropdown = add_slider = add_markdown = add_input

    def show(self, source, stopped):
        pass

    def close(self):
        pass

    def put(self, begin, value):
        """Move the input whose label begins so, as a browser does."""
        next(one for label, one in self.inputs.items() if label.startswith(begin)).value = value

    def press(self, label, value=None):
        self.inputs[label].value = value
        self.clicks[label](None)
