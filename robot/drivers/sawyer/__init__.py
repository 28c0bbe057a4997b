"""Driver of a Sawyer arm behind rosbridge."""
