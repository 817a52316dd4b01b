"""What the first results need is loaded by results of both types."""

from sceneloom.service.warming import warm_up


def test_both_fusions_give_a_result():
    assert warm_up() == 2
