"""Every wrong use of the library raises one sentence: the given, the allowed and the remedy."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from support import wrong_calls

ROOT = Path(__file__).parent.parent
wrong_calls.register_wrong_calls()


@pytest.fixture(scope="module")
def wrong_call_messages(tmp_path_factory) -> dict[str, tuple[str, str, str]]:
    """Results of all calls, in a process that starts as a user's does and may write nothing."""
    folder = tmp_path_factory.mktemp("empty")
    cache = os.environ.get("VRW_TEST_CACHE", ROOT / ".jax_cache")
    run = subprocess.run(
        [sys.executable, ROOT / "tests/support/wrong_calls.py", str(cache)],
        cwd=folder, env=os.environ | {"PYTHONPATH": str(ROOT)}, capture_output=True, text=True,
    )  # fmt: skip
    assert run.returncode == 0, run.stderr[-2000:]
    assert not list(folder.iterdir())
    return json.loads(run.stdout)


def test_there_are_many_wrong_calls():
    assert len(wrong_calls.WRONG_CALLS) >= 250


@pytest.mark.parametrize("name", wrong_calls.WRONG_CALLS)
def test_a_wrong_call_is_refused_in_one_sentence(wrong_call_messages, name):
    kind, sentence, refused_in = wrong_call_messages[name]
    expected = wrong_calls.WRONG_CALLS[name]
    assert kind == expected.error_type, sentence
    assert expected.expected_words in sentence
    assert sentence.endswith(".")
    assert "\n" not in sentence
    assert ": " in sentence  # the remedy follows
    assert "vrw_jax" in refused_in
