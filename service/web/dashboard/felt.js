// A finger's imprint in grey, and over it how its markers moved: by colour and shape, which of them slip.
const COLOURS = ["#8fa0b0", "#35c6c0", "#ff5b45"];
const [OUTSIDE, SLIPS] = [0, 2]; // a dashed arrow, and one from a square spot: grey eyes see no colour
const SPOT = 3;
const GAIN = 4;
const STATES = { no_contact: "touches nothing", grasping: "being closed", hold: "holds still", contact: "feels an edge", incipient_slip: "slip begins", gross_slip: "slides", release: "lets go", lost: "sees no markers", unknown: "not judged", watching: "live picture" };

export function drawFelt(canvas, caption, content) {
  const image = new Image();
  image.onload = () => {
    const pen = canvas.getContext("2d");
    canvas.height = Math.round((canvas.width * content.height) / content.width);
    const scale = canvas.width / content.width;
    pen.drawImage(image, 0, 0, canvas.width, canvas.height);
    pen.fillStyle = "rgb(10 16 22 / .5)";
    pen.fillRect(0, 0, canvas.width, canvas.height);
    for (const kind of [0, 1, 2]) arrows(pen, content, kind, scale);
  };
  image.src = `data:image/jpeg;base64,${content.jpeg}`;
  const slips = content.state.includes("slip");
  caption.textContent = `${STATES[content.state] ?? content.state}${slips || content.state === "watching" ? "" : `, slip ${Math.round(100 * Math.min(content.score, 1))} %`}`;
  caption.className = slips ? "slip" : "";
}

function arrows(pen, { rest, moved, kinds }, kind, scale) {
  pen.strokeStyle = pen.fillStyle = COLOURS[kind];
  pen.lineWidth = 1.5 + 0.6 * kind;
  pen.setLineDash(kind === OUTSIDE ? [5, 4] : []);
  pen.beginPath();
  kinds.forEach((one, i) => {
    if (one !== kind) return;
    const x = rest[2 * i] * scale, y = rest[2 * i + 1] * scale;
    if (kind === SLIPS) pen.fillRect(x - SPOT, y - SPOT, 2 * SPOT, 2 * SPOT);
    const dx = GAIN * moved[2 * i] * scale, dy = GAIN * moved[2 * i + 1] * scale, long = Math.hypot(dx, dy);
    pen.moveTo(x, y);
    pen.lineTo(x + dx, y + dy);
    if (long < 7) return;
    const ux = dx / long, uy = dy / long, barb = Math.min(8, 0.4 * long);
    pen.lineTo(x + dx - barb * (ux + 0.6 * uy), y + dy - barb * (uy - 0.6 * ux));
    pen.moveTo(x + dx, y + dy);
    pen.lineTo(x + dx - barb * (ux - 0.6 * uy), y + dy - barb * (uy + 0.6 * ux));
  });
  pen.stroke();
}
