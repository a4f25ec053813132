import torch
from hypothesis import given
from hypothesis import strategies as st

from stages.perception.detection.trained.offsets import apply_offsets, encode_offsets


def box_strategy() -> st.SearchStrategy[tuple[float, float, float, float]]:
    corner, size = st.floats(0, 300), st.floats(4, 200)
    return st.tuples(corner, corner, size, size).map(lambda b: (b[0], b[1], b[0] + b[2], b[1] + b[3]))


@given(box_strategy(), st.floats(0.3, 3), st.floats(0.3, 3), st.floats(-30, 30))
def test_offsets_take_the_anchor_back_to_its_box(
    anchor: tuple[float, float, float, float], wider: float, higher: float, shift: float
) -> None:
    x0, y0, x1, y1 = anchor
    box = torch.tensor([[x0 + shift, y0 - shift, x0 + shift + wider * (x1 - x0), y0 - shift + higher * (y1 - y0)]])
    anchors = torch.tensor([anchor])
    torch.testing.assert_close(apply_offsets(anchors, encode_offsets(anchors, box)), box, atol=1e-2, rtol=1e-4)
