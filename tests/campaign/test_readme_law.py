"""The law that needle_sim's README prints steers as many needles as it says there."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

README = Path(__file__).parents[2] / "ros2_ws" / "src" / "needle_sim" / "README.md"


def test_the_readme_s_own_law_runs_as_it_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    text = README.read_text("utf-8")
    (code,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    exec(compile(code, "README.md", "exec"), {})
    assert f"It prints {float(capsys.readouterr().out):.3f}" in text
