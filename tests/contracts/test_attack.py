import pytest

from tests.fixtures.attack import attack_all, counts_table


@pytest.mark.slow
def test_damaged_and_hostile_inputs():
    attacked = attack_all()
    print(counts_table(attacked))
    assert not attacked.failures, "\n".join(attacked.failures)
    total = sum(attacked.counts.values())
    assert total >= 300
    # attacks that no reader minds, or that all do, would test nothing
    refused = sum(n for (_, verdict), n in attacked.counts.items() if verdict == "refused")
    assert 0.3 < refused / total < 0.95
