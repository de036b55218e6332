# SPDX-License-Identifier: Apache-2.0
"""
Which tests share a worker of pytest-xdist: those that use the same fixture of their module.

Such fixtures start nodes or simulate logs, and some of these tests go on where the one before has
left the node.  Every other test goes to the worker that is free.
"""

import ast
import functools

from xdist.scheduler import LoadScopeScheduling


class BySharedFixture(LoadScopeScheduling):
    """Groups of tests first, the largest first; then the others."""

    def _split_scope(self, nodeid):
        """Return the name of the group that a test belongs to; its own, if to none."""
        file, _, test = nodeid.partition('::')
        fixture = shared_fixtures(self.config.rootpath / file).get(test.partition('[')[0])
        return f'{file}: {fixture}' if fixture else nodeid


@functools.cache
def shared_fixtures(path):
    """Return {test: the module's fixture that it uses, through others too} of a test file."""
    functions = {node.name: node for node in ast.parse(path.read_text()).body
                 if isinstance(node, ast.FunctionDef)}
    return {name: shared for name in functions
            if name.startswith('test') and (shared := _shared(name, functions))}


def _shared(name, functions):
    """Return the fixture of the module at the root of a test or fixture, or None."""
    if name not in functions:
        return None
    arguments = sorted(argument.arg for argument in functions[name].args.args)
    found = next(filter(None, (_shared(argument, functions) for argument in arguments)), None)
    if found is None and any("scope='module'" in ast.unparse(decorator)
                             for decorator in functions[name].decorator_list):
        return name
    return found
