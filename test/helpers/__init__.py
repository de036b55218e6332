# SPDX-License-Identifier: Apache-2.0
"""What tests share: nodes as processes, their logs, reference cases, random tops."""
