# SPDX-License-Identifier: Apache-2.0
"""
What random inputs and faults must not break: each part has `check(seed, folder)`.

It raises for whatever is wrong with a seed.  test_stress.py runs some seeds of each; a seed that
takes longer than PATIENCE_S, or more memory than MEMORY_MB, is a failure, too.
"""
