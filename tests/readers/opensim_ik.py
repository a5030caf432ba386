"""OpenSim's own opinion on TRC, MOT, OSIM and STO files; needs no fusecap.

    python opensim_ik.py MODEL.osim MARKERS.trc ANGLES.mot ORIENTATIONS.sto OUT.npz

Runs inverse kinematics from the markers on the model. OUT receives the coordinates it found and
those of the MOT file, where the model's markers lie in the poses of the MOT file and where the TRC
file has them, and the orientations of bodies of both the poses and the STO file.
"""

from __future__ import annotations

import json
import sys

import numpy as np
import opensim


def main() -> None:
    model_path, trc, mot, sto, out = sys.argv[1:]
    opensim.Logger.setLevelString("error")
    model = opensim.Model(model_path)
    state = model.initSystem()
    angles = opensim.TimeSeriesTable(mot)
    names = list(angles.getColumnLabels())
    times = np.array(angles.getIndependentColumn())
    read = np.array(
        [[angles.getRowAtIndex(r)[c] for c in range(len(names))] for r in range(len(times))]
    )
    markers = opensim.MarkersReference(trc, opensim.SetMarkerWeights())
    orientations = opensim.TimeSeriesTableQuaternion(sto)
    solver = opensim.InverseKinematicsSolver(
        model, markers, opensim.SimTKArrayCoordinateReference(), float("inf")
    )
    solver.setAccuracy(1e-7)
    coordinates = [model.getCoordinateSet().get(name) for name in names]
    rotational = [c.getMotionType() == 1 for c in coordinates]
    found = np.empty_like(read)
    for row, time_s in enumerate(times):
        state.setTime(float(time_s))
        if row == 0:
            for column, coordinate in enumerate(coordinates):
                value = read[row, column]
                coordinate.setValue(
                    state, float(np.radians(value)) if rotational[column] else value
                )
            solver.assemble(state)
        else:
            solver.track(state)
        values = [coordinate.getValue(state) for coordinate in coordinates]
        found[row] = [np.degrees(v) if r else v for v, r in zip(values, rotational, strict=True)]
    table = opensim.TimeSeriesTableVec3(trc)
    labels = list(table.getColumnLabels())
    unit = 1e-3 if table.getTableMetaDataAsString("Units") == "mm" else 1.0
    in_file, in_model = np.empty((2, len(times), len(labels), 3))
    bodies = [label.removesuffix("_imu") for label in orientations.getColumnLabels()]
    turn_file, turn_model = np.empty((2, len(times), len(bodies), 4))
    for row in range(len(times)):
        for column, coordinate in enumerate(coordinates):
            value = read[row, column]
            coordinate.setValue(
                state, float(np.radians(value)) if rotational[column] else value, False
            )
        model.realizePosition(state)
        for index, label in enumerate(labels):
            place = model.getMarkerSet().get(label).getLocationInGround(state)
            in_model[row, index] = [place.get(k) for k in range(3)]
            cell = table.getRowAtIndex(row)[index]
            in_file[row, index] = [unit * cell.get(k) for k in range(3)]
        for index, body in enumerate(bodies):
            turn = model.getBodySet().get(body).getTransformInGround(state).R()
            quaternion = turn.convertRotationToQuaternion()
            turn_model[row, index] = [quaternion.get(k) for k in range(4)]
            cell = orientations.getRowAtIndex(row).getElt(0, index)
            turn_file[row, index] = [cell.get(k) for k in range(4)]
    np.savez(
        out,
        names=np.array(names),
        mot=read,
        ik=found,
        rotational=np.array(rotational),
        in_file=in_file,
        in_model=in_model,
        turn_file=turn_file,
        turn_model=turn_model,
    )
    print(json.dumps({"opensim": opensim.GetVersion(), "frames": len(times)}))


if __name__ == "__main__":
    main()
