"""A live run warns of what its sources contradict themselves in."""

import threading
from dataclasses import replace

from fusecap.checks import check_samples
from fusecap.evaluate.demo_scene import demo_scene
from fusecap.evaluate.simulated_session import write_session
from fusecap.live.input_check import InputCheck
from fusecap.sources.session_data import open_session
from fusecap.sources.session_file import load_session
from fusecap.types import CameraSample, ImuSample
from live_events import samples_of, setup_for


def test_what_a_run_takes_in_is_checked_once_it_has_come_for_a_while(tmp_path):
    data = open_session(load_session(write_session(demo_scene(seconds=2.0), tmp_path)))
    setup, samples = setup_for(data), samples_of(data)
    assert not [f for f in check_samples(setup, samples) if f.severity != "info"]

    def mirrored(sample):
        if isinstance(sample, CameraSample) and sample.camera == 2:
            return replace(sample, people=sample.people[:, setup.landmarks.mirror])
        return sample

    told = []
    check = InputCheck(setup, told.append, span_s=1.5)
    for sample in samples:
        check.on_event(mirrored(sample), sample.timestamp_ns)
    for thread in threading.enumerate():
        if thread.name == "input check":
            thread.join(120)
    check.close()
    assert any(t.startswith("camera 'cam3'") and "left and right exchanged" in t for t in told)


def test_sensors_without_a_mounting_are_no_matter_before_their_tpose(tmp_path):
    data = open_session(load_session(write_session(demo_scene(seconds=1.0), tmp_path)))
    setup = setup_for(data)
    subjects = tuple(
        subject.model_copy(
            update={
                "imus": tuple(
                    imu.model_copy(update={"bone_from_imu_wxyz": None}) for imu in subject.imus
                )
            }
        )
        for subject in setup.session.subjects
    )
    setup = replace(setup, session=setup.session.model_copy(update={"subjects": subjects}))
    only_sensors = [sample for sample in samples_of(data) if isinstance(sample, ImuSample)]
    assert not check_samples(setup, only_sensors)
