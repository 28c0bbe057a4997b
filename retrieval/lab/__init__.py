"""What measures the project itself: error against run time, hard cases, closed forms, fits of optics."""
