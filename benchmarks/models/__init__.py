"""Programs that train the shipped models and measure their accuracy."""
