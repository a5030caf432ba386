"""A setup is a value; what lives is built from it."""

from dataclasses import replace

import pytest

from fusecap.associate.options import TrackerOptions
from fusecap.batch.solve import SessionInstants, solve_instants
from fusecap.errors import SessionError
from fusecap.evaluate.demo_scene import demo_scene
from fusecap.evaluate.simulated_session import write_session
from fusecap.pipeline import Pipeline
from fusecap.setup import setup_of
from fusecap.sources.session_data import open_session
from fusecap.sources.session_file import load_session


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    folder = tmp_path_factory.mktemp("session")
    return open_session(load_session(write_session(demo_scene(0, seconds=1.0), folder)))


@pytest.fixture(scope="module")
def setup(data):
    return setup_of(data.session, data.rig, data.landmarks)


@pytest.mark.slow
@pytest.mark.parametrize("associate", ["tracker", "paper"])
def test_solving_one_setup_twice_gives_the_same_bits(data, setup, associate):
    setup = replace(setup, associate=associate)
    first, second = (solve_instants(setup, SessionInstants(data)).take for _ in range(2))
    assert first.tracked.any()
    assert first.subject_names == second.subject_names
    assert first.theta.tobytes() == second.theta.tobytes()
    assert first.bone_quality.tobytes() == second.bone_quality.tobytes()


def test_people_are_sorted_by_a_sorter_of_ones_own(data, setup):
    class Nobody:
        def update(self, detections, predicted, now_ns):
            return []

    step = Pipeline(setup, sorter=Nobody()).step(SessionInstants(data).detections(0), {})
    assert step.updates == step.estimates == ()


def test_whoever_is_to_be_found_anew_has_an_estimator_all_the_same(data, setup):
    pipeline = Pipeline(setup)
    pipeline.reinitialise()
    name = setup.subjects[0].name
    assert pipeline.estimator(name).model.name == name


def test_a_setup_that_nothing_can_sort_is_refused(setup):
    with pytest.raises(SessionError, match="two cameras or more"):
        replace(setup, associate="paper", rig=setup.rig.subset(setup.rig.names[:1]))
    with pytest.raises(SessionError, match="expected 'tracker' or 'paper'"):
        replace(setup, associate="nearest")


def test_a_lone_camera_follows_one_person_and_no_more(data, setup):
    rig, tracker = setup.rig.subset(setup.rig.names[:1]), TrackerOptions()
    alone = replace(setup, rig=rig, subjects=(), tracker=tracker)
    pipeline, instants, counts = Pipeline(alone), SessionInstants(data), set()
    for instant in range(len(instants)):
        detections = instants.detections(instant)
        step = pipeline.step(replace(detections, people=detections.people[:1]), {})
        counts.add(len(step.estimates))
    assert max(counts) == 1
    with pytest.raises(SessionError, match="one camera cannot tell 2 people apart"):
        Pipeline(replace(alone, tracker=replace(tracker, max_subjects=2)))
