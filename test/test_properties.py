# SPDX-License-Identifier: Apache-2.0
"""Inputs of any kind: parameters and YAML are read, or refused by name."""

import string

import numpy as np
import yaml
from helpers.examples import examples
from hypothesis import example, given
from hypothesis import strategies as st

from spinning_top_sim.streams import parameters
from spinning_top_sim.tools import scene_file

# Python shows no integer of more than 4300 digits; YAML has them, in hexadecimal.
NUMBERS = st.integers() | st.floats() | st.sampled_from((10 ** 400, -2 ** 63, 5e-324)) | st.just(
    15_000).map(lambda bits: 1 << bits)
# Names may be anything; but of more lines than one, a message that quotes them is too.
KEYS = st.text(st.characters(exclude_categories=('Cc', 'Cs', 'Zl', 'Zp')), max_size=5)
PLAIN = st.one_of(st.none(), st.booleans(), NUMBERS, st.text(max_size=8), st.dates(),
                  st.binary(max_size=4), st.complex_numbers())
ANYTHING = st.recursive(
    PLAIN, lambda inner: st.one_of(
        st.lists(inner, max_size=4), st.lists(inner, max_size=3).map(tuple),
        st.dictionaries(KEYS, inner, max_size=3), st.lists(st.floats(), min_size=3, max_size=9),
        st.sets(st.floats(0.0, 1.0), min_size=3, max_size=3)), max_leaves=6) | st.lists(
            st.floats(), min_size=3, max_size=3).map(np.array)
NAMES = st.sampled_from(sorted(parameters.BY_NAME))


def is_a_line(text):
    return '\n' not in text and text.strip() != ''


@examples(60)
@given(NAMES, ANYTHING)
def test_any_value_of_a_parameter_is_taken_or_refused_by_its_name(name, value):
    try:
        values = parameters.checked({name: value})
    except ValueError as refusal:
        assert str(refusal).startswith(f'{name} = '), refusal
        assert 'must be ' in str(refusal) and is_a_line(str(refusal))
        return
    assert parameters.checked(values) == values
    assert not isinstance(value, dict | set), 'without order there is no list'
    default = parameters.BY_NAME[name].default
    assert default is None or type(values[name]) is type(default)


YAML = st.text(st.sampled_from(string.printable + '\x00\x85\u2028\ud800\U0001f300'), max_size=60)
CONTENT = st.recursive(
    st.one_of(st.none(), st.booleans(), st.integers(), st.floats(), st.dates(),
              st.text(max_size=5)),
    lambda inner: st.one_of(st.lists(inner, max_size=3), st.dictionaries(
        NAMES | KEYS, inner, max_size=3)), max_leaves=8)


@examples(60)
@given(YAML | CONTENT.map(lambda content: yaml.dump({'/**': {'ros__parameters': content}},
                                                    allow_unicode=True)))
@example(f'/**: {{ros__parameters: {{imu.rpy: [1.0, {1 << 15_000:#x}]}}}}')
@example('/**: &a {b: *a}')
def test_any_parameter_file_is_read_or_refused_by_its_path(tmp_path, text):
    path = tmp_path / 'scene.yaml'
    path.write_bytes(text.encode(errors='surrogatepass'))
    try:
        values = scene_file.read_scene(path)
    except ValueError as refusal:
        assert str(path) in str(refusal) and is_a_line(str(refusal))
    else:
        assert values.keys() <= parameters.BY_NAME.keys()
