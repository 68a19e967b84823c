"""The page about fits works as it is written: every file, command and program, in its order."""

import pytest

from laboratory import ROOT
from test_tutorial import BLOCK, Block, as_pattern, follow

TEXT = (ROOT / "docs" / "fit.md").read_text()
BLOCKS = [Block(*(x or "" for x in match.groups())) for match in BLOCK.finditer(TEXT)]


def test_every_block_is_of_a_known_kind():
    assert len(BLOCKS) == TEXT.count("\n```") / 2
    assert {b.language for b in BLOCKS if not b.path} == {"", "python", "text"}


@pytest.mark.long
def test_it_prints_what_the_page_says(tmp_path):
    import re

    printed = follow(BLOCKS, tmp_path)
    assert len(printed) == sum(block.language == "text" for block in BLOCKS)
    for block, output in printed:
        found = " ".join(output.split())
        for line in block.body.splitlines():
            assert re.search(as_pattern(line), found), (line, output)
    drag = next(line for _, out in printed for line in out.splitlines() if line.startswith("drag:"))
    assert abs(float(drag.split()[1]) - 1.3) < 0.03
