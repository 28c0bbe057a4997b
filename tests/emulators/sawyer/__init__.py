"""A made-up arm behind a rosbridge server."""
