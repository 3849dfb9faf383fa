"""Instance segmentation of logs: a network's maps, segments, merged segments, masks."""
