"""A Sawyer behind rosbridge."""
