# SPDX-License-Identifier: Apache-2.0
"""Files of any kind: parameters and YAML are read, or refused by name."""

import string

import yaml
from helpers.examples import examples
from hypothesis import example, given
from hypothesis import strategies as st

from spinning_top_sim.streams import parameters
from spinning_top_sim.tools import scene_file

# Names may be anything; but of more lines than one, a message that quotes them is too.
KEYS = st.text(st.characters(exclude_categories=('Cc', 'Cs', 'Zl', 'Zp')), max_size=5)
NAMES = st.sampled_from(sorted(parameters.BY_NAME))
YAML = st.text(st.sampled_from(string.printable + '\x00\x85\u2028\ud800\U0001f300'), max_size=60)
CONTENT = st.recursive(
    st.one_of(st.none(), st.booleans(), st.integers(), st.floats(), st.dates(),
              st.text(max_size=5), st.binary(max_size=4), st.sampled_from((10 ** 400, 5e-324))),
    lambda inner: st.one_of(
        st.lists(inner, max_size=3), st.lists(st.floats(), min_size=3, max_size=9),
        st.sets(st.floats(0.0, 1.0), min_size=3, max_size=3),
        st.dictionaries(NAMES | KEYS, inner, max_size=3)), max_leaves=8)


@examples(120)
@given(YAML | CONTENT.map(lambda content: yaml.dump({'/**': {'ros__parameters': content}},
                                                    allow_unicode=True)))
@example(f'/**: {{ros__parameters: {{imu.rpy: [1.0, {1 << 15_000:#x}]}}}}')
@example('/**: {ros__parameters: {top.lambda1: 5.0e-234}}')
@example('/**: &a {b: *a}')
def test_any_parameter_file_is_read_or_refused_by_its_path(tmp_path, text):
    path = tmp_path / 'scene.yaml'
    path.write_bytes(text.encode(errors='surrogatepass'))
    try:
        values = scene_file.read_scene(path)
    except ValueError as refusal:
        assert str(path) in str(refusal) and '\n' not in str(refusal)
        return
    assert parameters.checked(values) == {**parameters.checked({}), **values}
