"""How a cluster is divided among workers."""

from hypothesis import given
from hypothesis import strategies as st

from pipeline.core.cluster import Node, Placement, plan_placement

NODES = st.lists(
    st.builds(Node, cpus=st.integers(1, 64), gpus=st.integers(0, 8)), min_size=1, max_size=5
)


def test_one_worker_per_gpu_else_per_eight_cores_and_all_of_them_fit() -> None:
    assert plan_placement([Node(cpus=2)], items=9) == Placement(workers=1, cpus=2, gpus=0)
    assert plan_placement([Node(cpus=2)], items=9, workers=2) == Placement(
        workers=2, cpus=1, gpus=0
    )
    assert plan_placement([Node(cpus=2)], items=9, workers=3) == Placement(
        workers=3, cpus=1, gpus=0
    )
    assert plan_placement([Node(cpus=16), Node(cpus=16)], items=9) == Placement(
        workers=4, cpus=8, gpus=0
    )
    assert plan_placement([Node(cpus=6)] * 3, items=9, workers=2) == Placement(
        workers=2, cpus=6, gpus=0
    )
    assert plan_placement([Node(cpus=32, gpus=4)], items=9) == Placement(workers=4, cpus=8, gpus=1)
    assert plan_placement([Node(cpus=32, gpus=4)], items=9, gpus=0.5) == Placement(
        workers=8, cpus=4, gpus=0.5
    )
    assert plan_placement([Node(cpus=32, gpus=4)], items=2, gpus=0) == Placement(
        workers=2, cpus=16, gpus=0
    )
    assert plan_placement([Node(cpus=0), Node(cpus=4)], items=9, cpus=2) == Placement(
        workers=2, cpus=2, gpus=0
    )


@given(NODES, st.integers(1, 100))
def test_what_is_chosen_for_the_user_has_room(nodes: list[Node], items: int) -> None:
    chosen = plan_placement(nodes, items)
    assert 1 <= chosen.workers <= items
    room = sum(
        min(node.cpus // chosen.cpus, node.gpus // chosen.gpus)
        if chosen.gpus
        else node.cpus // chosen.cpus
        for node in nodes
    )
    assert room >= chosen.workers


@given(NODES, st.integers(1, 100), st.integers(1, 64), st.integers(1, 64))
def test_what_the_user_says_is_asked_for(
    nodes: list[Node], items: int, workers: int, cpus: int
) -> None:
    chosen = plan_placement(nodes, items, workers, cpus, 0)
    assert (chosen.workers, chosen.cpus, chosen.gpus) == (min(workers, items), cpus, 0)
