import numba.cuda
import pytest

from benchmarks.perception import cuda


@pytest.mark.skipif(numba.cuda.is_available(), reason="a GPU is at hand")
def test_without_a_gpu_one_line_says_so(capsys: pytest.CaptureFixture[str]) -> None:
    cuda.main()
    said = capsys.readouterr().out
    assert said.startswith("nothing measured: numba finds no GPU")
    assert said.count("\n") == 1
