"""Matrix products of the CPU: chosen by a probe, restored for the user."""

import pytest
import torch as th

from sb3_rpto.dynamics import matmul_precision
from sb3_rpto.dynamics.matmul_precision import fast_products, no_denormals, pays


@pytest.fixture(autouse=True)
def restored():
    before = th.get_float32_matmul_precision()
    yield
    th.set_float32_matmul_precision(before)


@pytest.mark.parametrize(("faster", "inside"), [(True, "medium"), (False, "highest")])
def test_the_probe_decides_and_the_setting_comes_back(monkeypatch, faster, inside):
    monkeypatch.setattr(matmul_precision, "pays", lambda: faster)
    with fast_products():
        assert th.get_float32_matmul_precision() == inside
    assert th.get_float32_matmul_precision() == "highest"


def test_the_setting_comes_back_after_an_error(monkeypatch):
    monkeypatch.setattr(matmul_precision, "pays", lambda: True)
    with pytest.raises(KeyError), fast_products():
        raise KeyError
    assert th.get_float32_matmul_precision() == "highest"


def test_threads_that_come_and_go_restore_what_the_first_found(monkeypatch):
    monkeypatch.setattr(matmul_precision, "pays", lambda: True)
    first, second = fast_products(), fast_products()
    first.__enter__()
    second.__enter__()
    first.__exit__(None, None, None)
    assert th.get_float32_matmul_precision() == "medium"
    second.__exit__(None, None, None)
    assert th.get_float32_matmul_precision() == "highest"


def test_what_the_user_chose_stays(monkeypatch):
    monkeypatch.setattr(matmul_precision, "pays", lambda: True)
    th.set_float32_matmul_precision("high")
    with fast_products():
        assert th.get_float32_matmul_precision() == "high"


def test_other_devices_are_left_alone(monkeypatch):
    monkeypatch.setattr(matmul_precision, "pays", lambda: True)
    with fast_products("meta"):
        assert th.get_float32_matmul_precision() == "highest"


def test_the_probe_leaves_the_setting_and_refuses_what_is_inaccurate(monkeypatch):
    pays.cache_clear()
    monkeypatch.setattr(matmul_precision, "ACCURATE", 0.0)
    assert not pays()
    assert th.get_float32_matmul_precision() == "highest"
    pays.cache_clear()


@pytest.mark.parametrize(("gain", "chosen"), [(1.0, False), (1.2, False), (2.0, True)])
@pytest.mark.parametrize("busy", [range(0), range(50), range(40, 100)])
def test_a_busy_machine_chooses_as_an_idle_one(monkeypatch, gain, chosen, busy):
    """Other work takes three times as long as a product, for a part of the probe."""
    calls = iter(range(2 * 2 * matmul_precision.ROUNDS))
    clock = [0.0]

    def now():
        call = next(calls)
        if call % 2:
            product = 1.0 if th.get_float32_matmul_precision() == "highest" else 1.0 / gain
            clock[0] += product * (4.0 if call // 4 in busy else 1.0)
        return clock[0]

    pays.cache_clear()
    monkeypatch.setattr(matmul_precision, "ACCURATE", 1.0)
    monkeypatch.setattr(matmul_precision.time, "perf_counter", now)
    assert pays() == chosen
    pays.cache_clear()


def test_chosen_products_are_float32():
    generator = th.Generator().manual_seed(1)
    a, b = th.randn(64, 300, generator=generator), th.randn(300, 50, generator=generator)
    with fast_products():
        product = a @ b
    th.testing.assert_close(product.double(), a.double() @ b.double(), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("flushed", [False, True])
def test_numbers_below_the_smallest_normal_one_are_zero_inside_alone(flushed):
    if not th.set_flush_denormal(flushed):
        pytest.skip("this processor cannot take them for 0")
    tiny = th.full((8,), 2e-38)
    try:
        with no_denormals():
            assert (0.1 * tiny).count_nonzero() == 0
        assert (0.1 * tiny).count_nonzero() == (0 if flushed else 8)
        with pytest.raises(KeyError), no_denormals():
            raise KeyError
        assert (0.1 * tiny).count_nonzero() == (0 if flushed else 8)
    finally:
        th.set_flush_denormal(False)
