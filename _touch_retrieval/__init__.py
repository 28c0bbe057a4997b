"""What `indexes`, `robot` and `retrieval` share and none of them owns. Standard library only; not a public name."""
