import pytest

from tests.fixtures.attack import attack_all, told


@pytest.mark.slow
def test_damaged_and_hostile_inputs():
    found = attack_all()
    print(told(found))
    assert not found.failures, "\n".join(found.failures)
    total = sum(found.counts.values())
    assert total >= 300
    # attacks that no reader minds, or that all do, would test nothing
    refused = sum(n for (_, verdict), n in found.counts.items() if verdict == "refused")
    assert 0.3 < refused / total < 0.95
