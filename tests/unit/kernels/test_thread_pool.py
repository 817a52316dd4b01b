import threading

import numpy as np
import pytest

from sceneloom.kernels.thread_pool import ALONE, Phase, ThreadPool


@pytest.mark.parametrize("size", [1, 2, 3, 5])
@pytest.mark.parametrize("count", [0, 1, 2, 7, 100])
@pytest.mark.parametrize("rounds", [1, 4])
def test_all_is_shared_out_once_and_rounds_spread_the_chunks_of_each_part_over_the_whole(size, count, rounds):
    seen = []
    ThreadPool(size).share(Phase(count, lambda part, start, stop: seen.append((start, stop, part)), rounds=rounds))
    chunks = sorted(seen)
    assert [i for start, stop, _ in chunks for i in range(start, stop)] == list(range(count))
    assert max(stop - start for start, stop, _ in chunks) <= -(-count // size)
    if size > 1 and count == 100:
        assert [part for _, _, part in chunks] == [*range(size)] * rounds


@pytest.mark.parametrize("size", [1, 2])
@pytest.mark.parametrize("broken", [0, 1, 5])
def test_what_a_task_raises_is_raised_and_the_thread_pool_goes_on(size, broken):
    def work(number):
        if number == broken:
            raise ValueError(f"task {number}")
        return number

    thread_pool = ThreadPool(size)
    with pytest.raises(ValueError, match=f"task {broken}"):
        thread_pool.gather([lambda n=n: work(n) for n in range(6)])
    assert thread_pool.gather([lambda: 1, lambda: 2]) == [1, 2]


def test_several_threads_may_have_one_thread_pool_work():
    sums = [0] * 8

    def call(number):
        for _ in range(50):
            sums[number] += sum(ThreadPool(2).gather([lambda: 1, lambda: 2, lambda: 3]))

    threads = [threading.Thread(target=call, args=(n,)) for n in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    assert sums == [300] * 8


def test_phases_follow_each_other_parts_run_side_by_side_and_results_keep_their_order():
    seen, total = np.zeros(100, np.int64), []
    ThreadPool(3).share(
        Phase(100, lambda _, a, b: seen[a:b].fill(1)), Phase(1, lambda part, *_: total.append((part, seen.sum())))
    )
    assert {count for _, count in total} == {100}
    meeting = threading.Barrier(3, timeout=30)
    ThreadPool(3).share(Phase(3, lambda *_: meeting.wait()))
    assert not meeting.broken
    assert ThreadPool(2).gather([lambda n=n: n * n for n in range(20)]) == [n * n for n in range(20)]
    assert ThreadPool(4).gather([]) == []
    assert ThreadPool.of(8, 100) is ALONE
    assert ThreadPool.of(8, 1_000_000) == ThreadPool(8)
