# SPDX-License-Identifier: Apache-2.0
"""The notebook examples/tour.ipynb runs, and is committed without outputs."""

import os

import pytest
from helpers.reference import ROOT

NOTEBOOK = ROOT / 'examples/tour.ipynb'


def test_the_tour_runs_to_its_end():
    nbclient, nbformat = pytest.importorskip('nbclient'), pytest.importorskip('nbformat')
    pytest.importorskip('ipykernel')
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    assert all(cell.get('outputs', []) == [] for cell in notebook.cells)
    # Its assertions, too: an error in a cell is raised here.
    nbclient.NotebookClient(notebook, timeout=240, kernel_name='python3', resources={
        'metadata': {'path': str(ROOT)}}).execute(
            env={**os.environ, 'PYTHONPATH': os.pathsep.join(
                filter(None, [str(ROOT), os.environ.get('PYTHONPATH')]))})
    outputs = [output for cell in notebook.cells for output in cell.get('outputs', ())]
    pictures = [output for output in outputs if 'image/png' in output.get('data', {})]
    assert len(pictures) == 5
    assert any('cusps' in output.get('text', '') for output in outputs)
    assert any('<div class="animation"' in output.get('data', {}).get('text/html', '')
               for output in outputs)
