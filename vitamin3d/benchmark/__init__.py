# SPDX-License-Identifier: Apache-2.0
"""All sequences of a benchmark, several trials each, and the paper's tables of what came out."""
