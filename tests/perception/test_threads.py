import threading

import pytest
import torch

from perception.threads import spread


@pytest.fixture(params=[1, 2])
def threads(request: pytest.FixtureRequest):
    before = torch.get_num_threads()
    torch.set_num_threads(request.param)
    yield request.param
    torch.set_num_threads(before)


def test_results_keep_the_order_of_the_items(threads: int) -> None:
    assert spread(lambda x: x * x, range(20)) == [x * x for x in range(20)]
    assert spread(lambda x: x, []) == []


def test_items_are_worked_on_at_the_same_time_when_torch_has_threads(threads: int) -> None:
    meeting = threading.Barrier(2, timeout=0.3 if threads == 1 else 30.0)

    def meet(_: int) -> bool:
        try:
            meeting.wait()
        except threading.BrokenBarrierError:
            return False
        return True

    assert all(spread(meet, range(2))) == (threads == 2)


def test_what_an_item_raises_is_raised(threads: int) -> None:
    with pytest.raises(ZeroDivisionError):
        spread(lambda x: 1 // x, [1, 0, 2])
