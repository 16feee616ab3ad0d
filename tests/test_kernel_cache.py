import gc

import pytest
from numba.core import event
from numba.core.errors import TypingError
from numba.core.event import Listener

from tomopose.kernel_cache import njit


class Looks(Listener):
    """Whether the garbage collector works when compilations start."""

    def __init__(self):
        self.seen = []

    def on_start(self, event):
        self.seen.append(gc.isenabled())

    def on_end(self, event):
        pass


@pytest.fixture
def looks():
    njit()  # its own listener is told first
    listener = Looks()
    event.register("numba:compile", listener)
    yield listener
    event.unregister("numba:compile", listener)


def kernel_that_calls_another():
    @njit()
    def inner(x):
        return x + 1.0

    @njit()
    def outer(x):
        return inner(x) * 2.0

    return outer


def test_the_garbage_collector_rests_while_kernels_compile_and_no_longer(looks):
    assert gc.isenabled()
    assert kernel_that_calls_another()(1.0) == 4.0
    assert looks.seen == [False, False]
    assert gc.isenabled()


def test_a_collector_that_the_user_has_switched_off_stays_off():
    gc.disable()
    try:
        kernel_that_calls_another()(1.0)
        assert not gc.isenabled()
    finally:
        gc.enable()


def test_the_collector_works_again_after_a_kernel_that_cannot_be_compiled():
    with pytest.raises(TypingError):
        kernel_that_calls_another()("1")
    assert gc.isenabled()
