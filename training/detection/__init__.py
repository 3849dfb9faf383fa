"""Training of the log detectors: segmentation network, segment scorers, paper B's boxes."""
