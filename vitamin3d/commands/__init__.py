# SPDX-License-Identifier: Apache-2.0
"""The commands of the console script, one module each; what is heavy is imported when a command runs."""
