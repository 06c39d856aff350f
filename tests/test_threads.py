"""Work on several threads: nothing that is kept of one object makes the others wait."""

import threading

import pytest

from torchchain.threads import beside, core_free, kept_property, map_in_order, meanwhile


def test_kept_properties_of_two_objects_are_computed_at_once():
    both = threading.Barrier(2, timeout=20)  # broken where one waits for the other

    class Slow:
        @kept_property
        def value(self):
            """Told."""
            both.wait()
            return threading.get_ident()

    pair = Slow(), Slow()
    threads = [threading.Thread(target=lambda one=one: one.value) for one in pair]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert [one.__dict__["value"] for one in pair] == [thread.ident for thread in threads]
    assert pair[0].value == threads[0].ident  # not computed again, which would break the barrier
    assert Slow.value.__doc__ == "Told."


def test_other_work_begins_with_the_first_result_and_ends_before_what_follows():
    seen, begun = [], threading.Event()

    def other():
        begun.set()
        seen.append("other")

    with meanwhile(other, 2):
        assert not begun.wait(0.05)
        for i in map_in_order(abs, range(4), 2):
            assert begun.wait(20)
            if i == 0:
                seen.append("first")
    assert sorted(seen) == ["first", "other"]


def test_other_work_is_not_done_where_nothing_is_mapped_or_something_fails():
    seen = []
    with meanwhile(lambda: seen.append("unwanted"), 2):
        pass
    with pytest.raises(ZeroDivisionError), meanwhile(lambda: seen.append("unwanted"), 2):
        raise ZeroDivisionError
    with meanwhile(lambda: seen.append("unwanted"), 1):
        list(map_in_order(abs, range(4), 2))
    assert not [
        thread
        for thread in threading.enumerate()
        if thread.name.startswith("torchchain") and not thread.join(20) and thread.is_alive()
    ]
    assert seen == []


@pytest.mark.parametrize("workers", [1, 2])
def test_work_beside_begins_with_a_free_core_or_when_its_result_is_asked_for(workers):
    begun = threading.Event()

    def work():
        begun.set()
        return threading.current_thread().name

    with beside(work, workers) as found:
        assert not begun.wait(0.05)
        core_free()
        assert workers == 1 or begun.wait(20)
        assert found().startswith("torchchain") == (workers == 2)
    begun.clear()
    with beside(work, workers, at_once=True) as found:
        assert workers == 1 or begun.wait(20)
    begun.clear()
    with beside(work, workers) as found:
        found()
    assert begun.is_set()


def test_work_beside_what_fails_is_not_begun():
    seen = []
    with pytest.raises(ZeroDivisionError), beside(lambda: seen.append("unwanted"), 2):
        raise ZeroDivisionError
    core_free()  # nothing waits any more
    assert not [
        thread
        for thread in threading.enumerate()
        if thread.name.startswith("torchchain") and not thread.join(20) and thread.is_alive()
    ]
    assert seen == []
