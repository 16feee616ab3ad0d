"""Review: a person looks at detections in a browser and decides; every decision is solved again at once.

session   the values: what was detected, what was decided, what follows; `Review` changes by returning a new one
view      a session as the page sees it: rows, parameters, verdict, figures
crops     the part of a radiograph about a ball, as it is in the file
guard     who may ask: token, Host, Origin
app       the application; `server` runs it on the loopback address
watch     images as they arrive: what they cover, what is known so far, which pose would help most
"""
