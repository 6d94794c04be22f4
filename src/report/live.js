(() => {
  const byId = (id) => document.getElementById(id);
  const view = viewer(byId("viewer"), JSON.parse(byId("viewer-data").textContent));
  const picture = byId("picture"), image = byId("image"), line = byId("line"), status = byId("status");
  const STEPS = 2000, REST_MS = 400, AGAIN_MS = 1000, SLOW_MS = 1000;

  // The newest values have the number `wanted`; what is drawn, `drawn`.
  let wanted = 1, drawn = 0, asking = false, making = null, last = null, resting, head;
  const number = (value) => String(Number(value.toPrecision(6)));

  // Values: a slider and a field each; what is not touched stays the scene's. The page starts with a frame in mid scan.
  const sliders = [...document.querySelectorAll(".value")].map((root) => {
    const { key, start, low, high } = root.dataset;
    const [text, range] = [root.querySelector("[type=text]"), root.querySelector("[type=range]")];
    const whole = key === "frame", ratios = "ratios" in root.dataset, scale = ratios ? Math.log : (x) => x;
    const ends = [scale(Number(low)), scale(Number(high))];
    const self = { key, root, value: Number(start), changed: false };
    range.max = whole ? high : STEPS;
    range.min = whole ? low : 0;
    const place = () => (whole ? self.value : ((scale(self.value) - ends[0]) / (ends[1] - ends[0] || 1)) * STEPS);
    const put = (value, changed) => {
      [self.value, self.changed] = [value, changed];
      root.classList.toggle("changed", changed);
      range.setAttribute("aria-valuetext", number(value));
    };
    const wrong = (message) => {
      root.querySelector(".wrong").textContent = message;
      text.setAttribute("aria-invalid", message ? "true" : "false");
    };
    self.wrong = wrong;
    self.reset = () => {
      put(Number(start), false);
      text.value = number(self.value);
      range.value = place();
      wrong("");
    };
    range.oninput = () => {
      const share = ends[0] + (range.value / STEPS) * (ends[1] - ends[0]);
      const value = whole ? Number(range.value) : Number((ratios ? Math.exp(share) : share).toPrecision(4));
      // Not the rounding of a log or a share, where it means 0.
      put(Math.abs(value) < 1e-9 * (high - low) ? 0 : value, true);
      text.value = number(self.value);
      changed();
    };
    range.onchange = () => rest(0);
    text.onchange = () => {
      const typed = text.value.trim().replace(",", ".");
      const value = Number(typed);
      if (typed === "" || !Number.isFinite(value)) return wrong(`found "${text.value}", expected a number`);
      put(value, true);
      range.value = place();
      changed();
      rest(0);
    };
    text.onkeydown = (e) => {
      if (e.key === "Enter") e.preventDefault(), text.onchange();
    };
    self.reset();
    return self;
  });
  const asked = () => {
    const query = new URLSearchParams();
    for (const { key, value, changed } of sliders) if (changed || key === "frame") query.set(key, value);
    return query.toString();
  };

  const say = (text, kind) => {
    status.textContent = text;
    status.className = kind || "";
  };
  const get = async (what, query, signal) => {
    const answer = await fetch(`${what}?${query}`, { signal });
    if (answer.ok) return answer;
    const refused = await answer.json().catch(() => ({ message: `the server answers ${answer.status}` }));
    // The service's own refusals name no slider.
    const why = refused.error ?? refused;
    throw Object.assign(new Error(why.message), { refused: why });
  };

  // A picture: length of its head, the head, 8 bits a pixel.
  const show = (bytes) => {
    const length = new DataView(bytes).getUint32(0, true);
    head = JSON.parse(new TextDecoder().decode(new Uint8Array(bytes, 4, length)));
    const grey = new Uint8Array(bytes, 4 + length);
    if (image.width !== head.columns || image.height !== head.rows) {
      [image.width, image.height] = [line.width, line.height] = [head.columns, head.rows];
    }
    const context = image.getContext("2d");
    const pixels = context.createImageData(head.columns, head.rows);
    const words = new Uint32Array(pixels.data.buffer);
    for (let i = 0; i < words.length; i++) words[i] = 0xff000000 | (grey[i] * 0x010101);
    context.putImageData(pixels, 0, 0);
    drawLine();
    view.show(head.layers);
    for (const slider of sliders) slider.wrong("");
    picture.classList.remove("waiting");
    const [found, valid] = head.points, [most, full] = head.counts;
    byId("facts").textContent = `frame ${head.frame}: ${found} points, ${valid} without a flag; brightest ${most} of ` +
      `${full} counts; exposure ${number(head.exposure_ms)} ms`;
  };
  const drawLine = () => {
    if (!head) return;
    const context = line.getContext("2d");
    context.clearRect(0, 0, line.width, line.height);
    if (!byId("show-line").checked) return;
    // As wide on the screen however large the image.
    const wide = Math.max(1, line.width / (line.clientWidth || line.width));
    context.fillStyle = "#4aa8ff";
    for (const [column, row] of head.line) context.fillRect(column - 0.5, row - wide / 2, 1, wide);
  };
  byId("show-line").onchange = drawLine;

  // What went wrong, and whether to ask again by itself.
  const complain = (error) => {
    picture.classList.add("waiting");
    if (error.refused) {
      const slider = sliders.find(({ key }) => key === error.refused.key);
      if (slider) slider.wrong(error.message);
      say(`No picture of these values: ${slider ? slider.key + ": " : ""}${error.message}`, "wrong");
      return /^(too many|a newer draft)/.test(error.refused.message);
    }
    say("lasertrace does not answer; is it still running? The picture is of values before. Asking again.", "wrong");
    return true;
  };

  // Drafts: one request at a time, always of the newest values, so that none waits for another. While one is
  // drawn the next is made. One that takes longer than SLOW_MS gives way to newer values; before that it would never
  // be seen while a slider is dragged.
  const ask = () => {
    const own = new AbortController();
    const answer = get("draft", asked(), own.signal).then((answer) => answer.arrayBuffer());
    return (making = { number: wanted, start: performance.now(), own, answer });
  };
  const giveWay = () => {
    if (!making) return;
    const { number, start, own } = making;
    setTimeout(() => number < wanted && own.abort(), Math.max(0, start + SLOW_MS - performance.now()));
  };
  const pump = async () => {
    if (asking) return;
    asking = true;
    let next = null;
    while (next || drawn < wanted) {
      const { number, start, answer } = next ?? ask();
      next = null;
      try {
        const bytes = await answer;
        if (number < wanted) next = ask();
        // The final picture may have come first.
        if (drawn >= number) continue;
        show(bytes);
        say(`Draft: ${Math.round(performance.now() - start)} ms, of them ${Math.round(head.took_ms)} to make it. ` +
          `Planned for this frame alone; uncertainties come with the final picture.`);
      } catch (error) {
        if (number === wanted && complain(error)) rest(AGAIN_MS);
      }
      drawn = Math.max(drawn, number);
    }
    asking = false;
    document.body.dataset.drawn = drawn;
  };
  const changed = () => {
    wanted++;
    if (last) last.abort();
    last = null;
    byId("check").classList.add("waiting");
    for (const link of [byId("save"), byId("png")]) link.removeAttribute("href");
    rest(REST_MS);
    giveWay();
    pump();
  };

  // Once values rest: the final picture and what check says of them.
  const rest = (ms) => {
    clearTimeout(resting);
    resting = setTimeout(finish, ms);
  };
  const finish = async () => {
    if (last) last.abort();
    const own = (last = new AbortController()), number = wanted, query = asked();
    const start = performance.now();
    const waits = setInterval(() => {
      if (drawn === number && !picture.classList.contains("waiting"))
        say(`Draft; the final picture is in work, ${Math.round((performance.now() - start) / 1000)} s.`);
    }, 1000);
    try {
      const bytes = await (await get("final", query, own.signal)).arrayBuffer();
      if (last !== own) return;
      drawn = Math.max(drawn, number);
      clearInterval(waits);
      show(bytes);
      say(`Final picture: the bytes that render makes; ${Math.round(performance.now() - start)} ms.`, "final");
      byId("save").href = `scene.toml?${query}`;
      byId("png").href = `picture.png?${query}`;
      byId("command").textContent = `lasertrace render scene.toml --frame ${head.frame} -o out`;
      document.body.dataset.final = query || "-";
      await check(query, own);
    } catch (error) {
      if (last === own && error.name !== "AbortError" && complain(error)) rest(AGAIN_MS);
    } finally {
      clearInterval(waits);
    }
  };
  const check = async (query, own) => {
    byId("checked").textContent = "It is in work.";
    const { warnings, text, drawing } = await (await get("check", query, own.signal)).json();
    if (last !== own) return;
    byId("checked").textContent = warnings.length ? "" : "No warnings: the sensor measures the part on this path.";
    byId("warnings").replaceChildren(...warnings.map((warning) => {
      const item = document.createElement("li");
      item.textContent = warning;
      return item;
    }));
    byId("drawing").innerHTML = drawing;
    byId("page").textContent = text;
    byId("check").classList.remove("waiting");
  };

  byId("values").onreset = (e) => {
    e.preventDefault();
    for (const slider of sliders) slider.reset();
    changed();
    rest(0);
  };
  byId("values").onsubmit = (e) => e.preventDefault();
  window.addEventListener("resize", drawLine);
  rest(0);
})();
