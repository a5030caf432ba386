"""Takes as files of other programs (`formats/`), keypoints as files, pictures and overlays."""
