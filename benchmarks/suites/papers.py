"""The tables of the four papers, by methods that are trained for them.

Two core-days in all: residual forces beside none, prediction, correction of transitions, parts of a
universal controller, a compliant controller. Each part has its null and names in the column `policy`
what it trained.
"""

from __future__ import annotations

from benchmarks.suites import (
    papers_compliant,
    papers_dropout,
    papers_perpetual,
    papers_prediction,
    papers_residual,
    papers_skeleton,
    papers_ways,
)

PARTS = (
    papers_residual.PARTS
    | papers_prediction.PARTS
    | papers_skeleton.PARTS
    | papers_ways.PARTS
    | papers_dropout.PARTS
    | papers_perpetual.PARTS
    | papers_compliant.PARTS
)
