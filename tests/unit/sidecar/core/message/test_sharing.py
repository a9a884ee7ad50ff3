from __future__ import annotations

import random
import threading

from plr.sidecar.core.message.sharing import OFFER_S, Sharing


def always(_index: int) -> bool:
    return True


def test_each_symbol_goes_to_whoever_asks_first() -> None:
    sharing = Sharing(5, 0)
    assert sharing.take(2, always) == (0, 2)
    assert sharing.take(1, always) == (2, 1)
    assert sharing.untaken == 2
    assert sharing.take(9, always) == (3, 2)
    assert sharing.take(9, always) is None


def test_a_run_ends_before_what_is_not_needed_and_goes_on_behind_it() -> None:
    sharing = Sharing(6, 0)
    needed = {1, 2, 4, 5}.__contains__
    assert sharing.take(9, needed) == (1, 2)
    assert sharing.take(9, needed) == (4, 2)
    assert sharing.take(9, needed) is None


def test_the_last_path_to_leave_gets_what_nobody_would_carry() -> None:
    sharing = Sharing(3, 0)
    one, other = object(), object()
    sharing.join(one)
    sharing.join(other)
    sharing.take(1, always)
    assert sharing.leave(one) == ()
    assert sharing.leave(other) == (1, 2)
    assert sharing.leave(other) == ()


def test_a_path_hears_what_the_others_offered_lately() -> None:
    sharing = Sharing(3, 0)
    one, two, three = object(), object(), object()
    sharing.offer(one, 100.0, 0.01, now=1.0)
    sharing.offer(two, 50.0, 0.02, now=1.0)
    sharing.offer(three, 0.0, 0.03, now=1.0)
    assert sharing.others(three, 1.0) == (150.0, 0.01)
    assert sharing.others(one, 1.0) == (50.0, 0.02)
    sharing.withdraw(two)
    assert sharing.others(one, 1.0) == (0.0, 0.0)
    assert sharing.others(two, 1.0 + 2 * OFFER_S) == (0.0, 0.0)


def test_threads_that_take_at_once_get_each_symbol_once() -> None:
    count = 20_000
    sharing = Sharing(count, 0)
    taken: list[list[int]] = [[] for _ in range(4)]

    def pull(mine: list[int], rng: random.Random) -> None:
        while (run := sharing.take(rng.randint(1, 64), always)) is not None:
            mine.extend(range(run[0], sum(run)))

    threads = [threading.Thread(target=pull, args=(mine, random.Random(n))) for n, mine in enumerate(taken)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(index for mine in taken for index in mine) == list(range(count))


def test_what_got_lost_is_taken_again_before_all_others_and_once() -> None:
    sharing = Sharing(6, 0)
    assert sharing.take(4, always) == (0, 4)
    sharing.give_back((1, 2, 5))
    sharing.give_back((2,))
    assert sharing.untaken == 4, "5 was untaken anyway"
    assert sharing.take(9, always) == (1, 2)
    assert sharing.take(9, always) == (4, 2)
    assert sharing.take(9, always) is None
    sharing.give_back((0,))
    assert sharing.take_all() == (0,)
    sharing.give_back((0,))
    assert sharing.untaken == 1
