"""Every wrong use of the library gets one sentence: what was given, what is allowed, what to do."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from support import wrong_calls

ROOT = Path(__file__).parent.parent
wrong_calls.make()


@pytest.fixture(scope="module")
def answers(tmp_path_factory) -> dict[str, tuple[str, str, str]]:
    """What came of each, in a process that starts as a user's does; it may write nothing."""
    folder = tmp_path_factory.mktemp("empty")
    cache = os.environ.get("VRW_TEST_CACHE", ROOT / ".jax_cache")
    run = subprocess.run(
        [sys.executable, ROOT / "tests/support/wrong_calls.py", str(cache)],
        cwd=folder, env=os.environ | {"PYTHONPATH": str(ROOT)}, capture_output=True, text=True,
    )  # fmt: skip
    assert run.returncode == 0, run.stderr[-2000:]
    assert not list(folder.iterdir())
    return json.loads(run.stdout)


def test_there_are_many_of_them():
    assert len(wrong_calls.USES) >= 250


@pytest.mark.parametrize("name", wrong_calls.USES)
def test_it_gets_one_sentence(answers, name):
    kind, sentence, refused_in = answers[name]
    expected = wrong_calls.USES[name]
    assert kind == expected.kind, sentence
    assert expected.words in sentence
    assert sentence.endswith(".")
    assert "\n" not in sentence
    assert ": " in sentence  # what to do stands behind it
    assert "vrw_jax" in refused_in
