"""From a model and recordings to an identification problem."""
