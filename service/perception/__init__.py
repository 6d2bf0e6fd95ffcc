"""From a raw frame to markers, motion onset and slip. numpy and OpenCV only."""
