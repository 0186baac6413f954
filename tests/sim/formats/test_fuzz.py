import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.fixtures.fuzz_formats import attack, fuzz, text_targets

TARGETS = text_targets()


@pytest.mark.parametrize("name", TARGETS)
@settings(max_examples=60, deadline=None, suppress_health_check=list(HealthCheck))
@given(data=st.data())
def test_any_bytes(name, data):
    read, wholes = TARGETS[name]
    words = st.sampled_from([w for whole in wholes for w in whole[:2000].split()])
    line = st.lists(words | st.binary(max_size=6), max_size=12).map(b" ".join)
    text = st.lists(line, max_size=8).map(b"\n".join) | st.binary(max_size=200)
    attack(name, read, data.draw(text), with_lines=True)


def test_mutated_logs():
    counts = fuzz(1500, share_of_files=0.02)
    assert sum(counts.values()) == 1500
    # a mutation that no reader minds, or that every one does, would test nothing
    refused = sum(count for (_, verdict), count in counts.items() if verdict == "refused")
    assert 0.3 < refused / 1500 < 0.99


@pytest.mark.slow
def test_a_hundred_thousand_mutated_logs():
    assert sum(fuzz(100_000, seed=1).values()) == 100_000
