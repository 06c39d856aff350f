"""Work on several threads: nothing that is kept of one object makes the others wait."""

import threading

from torchchain.threads import kept_property


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
