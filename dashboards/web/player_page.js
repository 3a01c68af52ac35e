// The page of one episode.
"use strict";
load(JSON.parse(element("data").textContent));
