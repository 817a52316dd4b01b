"""What detectors wrote into files, whatever the form: lists of boxes in space and in images, by frame."""
