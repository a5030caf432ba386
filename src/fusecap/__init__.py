"""fusecap: full 6-DoF motion of several people from a few cameras and body-worn IMUs, live.

The names below are all that is public here. They load on first use, so that `import fusecap` stays
quick.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from fusecap.angles.joint_angles import JointAngles as JointAngles
    from fusecap.angles.joint_angles import joint_angles as joint_angles
    from fusecap.associate.options import TrackerOptions as TrackerOptions
    from fusecap.associate.tracker import Tracker as Tracker
    from fusecap.batch.solve import Solved as Solved
    from fusecap.batch.solve import SolveReport as SolveReport
    from fusecap.batch.solve import solve_session as solve_session
    from fusecap.body.landmarks import LandmarkSet as LandmarkSet
    from fusecap.body.landmarks import landmark_set_named as landmark_set_named
    from fusecap.body.prior import PosePrior as PosePrior
    from fusecap.body.prior import load_prior as load_prior
    from fusecap.body.shape import BodyShape as BodyShape
    from fusecap.body.skeleton import EXTENDED23 as EXTENDED23
    from fusecap.body.skeleton import PAPER21 as PAPER21
    from fusecap.body.skeleton import Skeleton as Skeleton
    from fusecap.edits.edit import EditOptions as EditOptions
    from fusecap.edits.edit import edit_take as edit_take
    from fusecap.errors import FusecapError as FusecapError
    from fusecap.exports.characters.retarget import retarget as retarget
    from fusecap.exports.take_files import export as export
    from fusecap.geometry.camera import Camera as Camera
    from fusecap.geometry.camera import Rig as Rig
    from fusecap.pipeline import Pipeline as Pipeline
    from fusecap.pipeline import Step as Step
    from fusecap.setup import Setup as Setup
    from fusecap.setup import setup_of as setup_of
    from fusecap.solve.estimator import Estimator as Estimator
    from fusecap.solve.estimator import SubjectModel as SubjectModel
    from fusecap.solve.options import SolverOptions as SolverOptions
    from fusecap.solve.options import Weights as Weights
    from fusecap.solve.pose_solver import ImuSites as ImuSites
    from fusecap.sources.session import Session as Session
    from fusecap.sources.session_data import open_session as open_session
    from fusecap.sources.session_file import load_session as load_session
    from fusecap.stored_take import load_take as load_take
    from fusecap.take import Take as Take
    from fusecap.take import save_take as save_take
    from fusecap.types import Detections as Detections
    from fusecap.types import Estimate as Estimate
    from fusecap.types import ImuReading as ImuReading
    from fusecap.types import Observation as Observation
    from fusecap.types import Status as Status

    __version__: str
else:
    # Type checkers read the imports above; here they are read as text, when a name is first used.
    def __getattr__(name):
        import importlib
        import importlib.metadata

        if name == "__version__":
            return importlib.metadata.version("fusecap")
        homes = _homes()
        if name == "__all__":
            return list(homes)
        if name not in homes:
            raise AttributeError(f"module 'fusecap' has no attribute '{name}'")
        globals()[name] = found = getattr(importlib.import_module(homes[name]), name)
        return found

    def __dir__():
        return sorted({*globals(), *_homes()})

    def _homes():
        """The module that each public name lives in."""
        import ast

        return {
            alias.asname: item.module
            for item in ast.walk(ast.parse(__loader__.get_source(__name__)))
            if isinstance(item, ast.ImportFrom)
            for alias in item.names
            if alias.asname
        }
