"""A trained model judged by views that it was not trained on."""
