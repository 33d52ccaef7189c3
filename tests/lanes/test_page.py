"""The page of machine code lists all primitives, and its example runs."""

import re
from pathlib import Path

from vrw_jax import lanes

PAGE = (Path(__file__).parents[2] / "docs" / "developer" / "machine_code.md").read_text()


def test_the_page_lists_all_primitives_and_each_has_a_description():
    listed_names = PAGE.split("## Primitives")[1].strip().split("\n\n")[1]
    descriptions = lanes.describe_supported_primitives()
    assert re.findall("`(.+?)`", listed_names) == sorted(descriptions)
    assert all(descriptions.values())


def test_the_example_of_the_simd_page_runs():
    exec(re.search("```python\n(.+?)```", PAGE, re.DOTALL)[1], {})
