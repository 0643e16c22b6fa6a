--[[
Lets an ArduPilot mission command the arm, and waits until the arm is done.

Copy to APM/scripts on the autopilot's SD card, set SCR_ENABLE to 1 and reboot. Then put into the mission

  NAV_SCRIPT_TIME   command 1..5 (see below), timeout in s, argument 1

and the mission goes on when the arm has finished, has failed, or the time is up. Or, where nothing should wait,

  DO_SEND_SCRIPT_MESSAGE   id 192, argument 1 as the command below, argument 2 as argument 1 there

Commands: 1 READY, 2 STOW, 3 PERCH (argument: kind, 0 is the anchor perch), 4 RELEASE, 5 ABORT.

Parameters of this script: ARMC_COMP is the arm's component id, ARMC_CHAN the MAVLink channel of the companion computer
(0 is the first MAVLink port; -1 is the one on which the arm is heard).
]]

local COMMAND_LONG, COMMAND_ACK, HEARTBEAT = 76, 77, 0
local ACCEPTED, IN_PROGRESS = 0, 5
local FIRST_COMMAND = 64000
local ORDERS = { FIRST_COMMAND, FIRST_COMMAND + 1, FIRST_COMMAND + 2, FIRST_COMMAND + 4, FIRST_COMMAND + 5 }
local NAMES = { "READY", "STOW", "PERCH", "RELEASE", "ABORT" }
local SEVERITY_WARNING, SEVERITY_INFO = 4, 6
local LOOK_EVERY_MS = 50
local RESEND_MS = 700

local TABLE_KEY = 192
assert(param:add_table(TABLE_KEY, "ARMC_", 2), "arm: no room for parameters")
assert(param:add_param(TABLE_KEY, 1, "COMP", 192), "arm: ARMC_COMP cannot be added")
assert(param:add_param(TABLE_KEY, 2, "CHAN", -1), "arm: ARMC_CHAN cannot be added")
local COMPONENT, CHANNEL = Parameter("ARMC_COMP"), Parameter("ARMC_CHAN")

mavlink:init(10, 2)
mavlink:register_rx_msgid(COMMAND_ACK)
mavlink:register_rx_msgid(HEARTBEAT)

local job = nil     -- what is under way: order, argument, mission item's id, time of the last sending
local heard = nil   -- channel of the arm's heartbeat: before it, the autopilot would take our command for its own

local function say(severity, text)
  gcs:send_text(severity, "arm: " .. text)
end

local function send(order, argument, confirmation)
  -- COMMAND_LONG in wire order: seven floats, command, system, component, confirmation
  local payload = string.pack("<fffffffHBBB", argument, 0, 0, 0, 0, 0, 0,
                              ORDERS[order], param:get("SYSID_THISMAV") or param:get("MAV_SYSID") or 1,
                              COMPONENT:get(), confirmation)
  -- never on a channel that there may not be: ArduPilot 4.7-dev SITL ends in a segmentation fault
  local chosen = CHANNEL:get()
  mavlink:send_chan(chosen >= 0 and chosen or heard, COMMAND_LONG, payload)
end

local function finish(text, severity)
  if job.item then
    vehicle:nav_script_time_done(job.item)
  end
  say(severity, NAMES[job.order] .. " " .. text)
  job = nil
end

local function start(order, argument, item)
  if not NAMES[order] then
    say(SEVERITY_WARNING, "no command " .. tostring(order))
    if item then vehicle:nav_script_time_done(item) end
    return
  end
  if not heard then
    say(SEVERITY_WARNING, "not heard; " .. NAMES[order] .. " is left out")
    if item then vehicle:nav_script_time_done(item) end
    return
  end
  job = { order = order, argument = argument, item = item, sent = millis(), tries = 0, running = false }
  send(order, argument, 0)
end

local function receive()
  while true do
    local message, channel = mavlink:receive_chan()
    if not message then return end
    -- frame as the firmware keeps it: three bytes of its own, then MAVLink 2's length, two flags, sequence, system,
    -- component, and three bytes of id; then the payload
    local _, _, _, _, _, _, system, component, id_low, id_mid, id_high = string.unpack("<HBBBBBBBBBB", message)
    local id = id_low + id_mid * 256 + id_high * 65536
    if component == COMPONENT:get() then
      if id == HEARTBEAT then
        heard = channel
      elseif id == COMMAND_ACK and job then
        local command, result = string.unpack("<HB", message, 13)
        if command == ORDERS[job.order] then
          if result == IN_PROGRESS then
            job.running = true
          elseif result == ACCEPTED then
            finish("done", SEVERITY_INFO)
          else
            finish("ended with result " .. tostring(result), SEVERITY_WARNING)
          end
        end
      end
    end
  end
end

local last_item = nil

local function update()
  receive()
  local item, order, argument = vehicle:nav_script_time()
  if item and item ~= last_item then
    last_item = item
    if job then job = nil end
    start(order, argument, item)
  elseif not item then
    last_item = nil
    if job and job.item then
      job = nil -- the mission went on without waiting: time-out, or the pilot
    end
  end
  local time, id, first, second = mission_receive()
  if time and id == 192 and not job then
    start(math.floor(first), second, nil)
  end
  if job and not job.running and (millis() - job.sent):tofloat() > RESEND_MS then
    job.tries = job.tries + 1
    if job.tries > 5 then
      finish("got no answer", SEVERITY_WARNING)
    else
      job.sent = millis()
      send(job.order, job.argument, job.tries)
    end
  end
  return update, LOOK_EVERY_MS
end

say(SEVERITY_INFO, "mission commands are ready")
return update()
