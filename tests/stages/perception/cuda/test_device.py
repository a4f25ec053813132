import numba.cuda
import pytest

from runner.contract import Refused
from stages.particle_filter import ParticleFilter
from stages.perception.cuda.device import chosen_device
from stages.perception.filter.iterations import CPU
from tests.stages.perception.scenes import CATALOGUE_FILE

HAS_GPU = numba.cuda.is_available()


def test_an_unknown_device_is_refused() -> None:
    with pytest.raises(Refused, match=r"^x\.device is 'tpu'; choose auto, cpu or cuda$"):
        chosen_device("tpu", place="x.device")


def test_the_cpu_is_always_there() -> None:
    assert chosen_device("cpu", place="x.device") is CPU


@pytest.mark.skipif(HAS_GPU, reason="a GPU is at hand")
def test_auto_is_the_cpu_where_there_is_no_gpu() -> None:
    assert chosen_device("auto", place="x.device") is CPU


@pytest.mark.skipif(HAS_GPU, reason="a GPU is at hand")
def test_a_gpu_that_is_not_there_is_refused_in_one_line() -> None:
    config = ParticleFilter.Config(catalogue=CATALOGUE_FILE, device="cuda")
    with pytest.raises(Refused) as refusal:
        ParticleFilter(config)
    assert str(refusal.value).startswith("particle_filter.device is 'cuda', but numba finds no GPU (")
    assert str(refusal.value).endswith("; choose auto or cpu")
    assert "\n" not in str(refusal.value)
