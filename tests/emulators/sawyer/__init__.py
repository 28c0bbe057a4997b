"""An emulated arm behind a rosbridge server."""
