# SPDX-License-Identifier: Apache-2.0
"""A page in the browser that shows a top, live or from a log.  Only its command imports it."""
