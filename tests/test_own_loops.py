"""The page on own optimisation loops does what it says, as it is written."""

import re
from pathlib import Path

import vrw_jax as vrw

PAGE = Path(__file__).parent.parent / "docs" / "own_loops.md"


def test_the_loop_on_the_page_climbs_and_keeps_its_premises(monkeypatch, capsys):
    (code,) = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.S)
    monkeypatch.setattr(vrw, "start_jax", lambda: None)  # it has started
    names: dict = {}
    exec(code, names)
    before, after = (vrw.limit_cycle(names["wheel"](u)) for u in ([1.8, 3.0], names["u"]))
    assert bool(after.found)
    assert float(after.dls_fraction) > float(before.dls_fraction) + 0.01
    assert float(after.takeoff_acceleration) > 0.0
    assert "damping c:" in capsys.readouterr().out
