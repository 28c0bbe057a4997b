"""The contact solver beside what is known without a grid."""
