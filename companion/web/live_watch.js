// Calls the page dead once no picture has arrived for long. The browser has to do it: the process
// that served the page, the companion behind it or the network between may be gone.
(() => {
  const DEAD_MS = 1500; // six pictures; with the time between two checks within two seconds
  const LOOK_MS = 250;
  let heardMs = null; // of the monotonic clock
  let heardAt = null;
  const bar = document.createElement("div");
  bar.id = "dead";
  bar.setAttribute("role", "alert");
  const look = () => {
    const isDead = heardMs !== null && performance.now() - heardMs > DEAD_MS;
    if (!document.body || isDead === document.body.classList.contains("is-dead")) return;
    if (!bar.isConnected) document.body.prepend(bar);
    const since = isDead ? heardAt.toISOString().slice(11, 19) : "";
    bar.textContent = isDead ? `Not live since ${since} UTC: what you see is old. `
      + "Watch the vehicle, and take over with the mode switch if in doubt." : "";
    document.body.classList.toggle("is-dead", isDead);
  };
  window.pictureHeard = (isLast) => { // after the last picture nothing is live, and says so
    heardMs = isLast ? null : performance.now();
    heardAt = new Date();
    look();
  };
  setInterval(look, LOOK_MS);
  document.addEventListener("visibilitychange", look); // a hidden page looks seldom
})();
