"""The page of machine code lists all primitives, and its example runs."""

import re
from pathlib import Path

from vrw_jax import lanes

PAGE = (Path(__file__).parents[2] / "docs" / "developer" / "machine_code.md").read_text()


def test_the_page_has_the_table_of_primitives():
    table = PAGE.split("## Primitives")[1].strip().split("\n\n")[0]
    rows = [row.strip("| ").split(" | ") for row in table.splitlines()[2:]]
    result_by_name = {name: does for names, does in rows for name in re.findall("`(.+?)`", names)}
    assert result_by_name == lanes.describe_supported_primitives()
    assert all(result_by_name.values())


def test_the_example_of_the_simd_page_runs():
    exec(re.search("```python\n(.+?)```", PAGE, re.DOTALL)[1], {})
