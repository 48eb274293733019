"""A viewer in the browser: exact renders from anywhere, temperatures under the cursor, and training as it goes on.

What is shown and measured knows nothing of the browser (``viewed_scene``, ``layers``, ``display``, ``measurements``,
``session``). ``front_end`` and what it imports put it on a page with viser.
"""
